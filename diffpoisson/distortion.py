"""Distortion of a map, from closed forms of its Jacobians' singular values.

All functions take Jacobians J of shape (…, c, d), maps of surfaces to the plane (2, 2) or to space
(3, 2) or of volumes (3, 3), and return one density per cell, (…); weigh by `mesh.measures` to
integrate.

Between spaces of equal dimension singular values are *signed*, σ₁ ≥ … ≥ |σ_d| with sign(σ_d) =
sign(det J): a negative σ_d is a flipped cell. Energies that punish collapse (symmetric Dirichlet,
MIPS, AMIPS, area) are infinite, with zero gradient, where det J ≤ 0. To optimise through flips,
their ε > 0 replaces det J in denominators by

    χ(det J) = (det J + √(ε² + det² J)) / 2 > 0            (Garanzha et al. 2021, eq. 4)

which tends to det J for det J ≫ ε and keeps pushing a flipped cell towards det J > 0.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from diffpoisson.arguments import require_number, require_single_or_double, require_tensor
from diffpoisson.rotations import nearest_rotation

Jacobian = Float[Tensor, "*batch c d"]
Density = Float[Tensor, "*batch"]


def singular_values(J: Jacobian) -> Float[Tensor, "*batch d"]:
    """Signed singular values, descending; the last has the sign of det J if J is square.

    First derivatives are finite everywhere; at a repeated value, where none exists, they are a
    subgradient.

    Raises:
        ValueError: J is not (…, 2, 2), (…, 3, 2) or (…, 3, 3).
    """
    if _shape(J) == (3, 3):
        require_single_or_double("singular_values", "J", J)
        # LAPACK refuses the whole batch for one NaN.
        finite = J.isfinite().all(-1, keepdim=True).all(-2, keepdim=True)
        magnitudes = torch.linalg.svdvals(torch.where(finite, J, 0))
        magnitudes = torch.where(finite[..., 0], magnitudes, torch.nan)
        # At unit size, where the determinant neither under- nor overflows.
        sign = torch.where(determinant(J / magnitudes[..., :1, None]) < 0, -1, 1).to(J)
        return torch.cat([magnitudes[..., :2], sign[..., None] * magnitudes[..., 2:]], dim=-1)
    total, difference = _sum_and_difference(J)
    return torch.stack([total + difference, total - difference], dim=-1) / 2


def closest_rotation(J: Jacobian) -> Jacobian:
    """The rotation Q that minimises ‖J - Q‖: the local step of Liu et al. 2008.

    Of a surface in space, (3, 2): the matrix of orthonormal columns that is closest. Where several
    are closest, the derivative is zero, and Q one of them: in the plane, where the similarity part
    of J vanishes, as it does for a reflection, the identity. In space, derivatives are exact up to
    third order. NaN where J is not finite.

    Raises:
        ValueError: J is not (…, 2, 2), (…, 3, 2) or (…, 3, 3).
    """
    if _shape(J) != (2, 2):
        require_single_or_double("closest_rotation", "J", J)
        if J.shape[-1] == 3:
            return nearest_rotation(J)
        # With a third column of zeros. The third of Q is then the normal.
        return nearest_rotation(torch.cat([J, torch.zeros_like(J[..., :1])], dim=-1))[..., :2]
    similarity, _ = similarity_parts(J)
    size = similarity.detach().abs().amax(-1, keepdim=True)
    none = size == 0
    similarity = similarity / torch.where(none, 1, size)  # squares stay within the range
    length = torch.linalg.vector_norm(similarity, dim=-1, keepdim=True)
    unit = similarity / torch.where(none, 1, length)
    p, q = torch.where(none, unit.new_tensor([1, 0]), unit).unbind(-1)
    return torch.stack([p, -q, q, p], dim=-1).unflatten(-1, (2, 2))


def determinant(J: Jacobian) -> Density:
    """det J, the ratio of measures: signed if J is square, positive for surfaces in space."""
    shape = _shape(J)
    if shape == (3, 3):
        return (torch.linalg.cross(J[..., 0], J[..., 1]) * J[..., 2]).sum(-1)
    if shape == (2, 2):
        a, b, c, d = _entries(J)
        return a * d - b * c
    u, v = J.unbind(-1)
    return torch.linalg.vector_norm(torch.linalg.cross(u, v), dim=-1)


def flipped(J: Jacobian) -> Bool[Tensor, "*batch"]:
    """Whether each cell is flipped or collapsed, det J ≤ 0 (the paper's #I counts them), or NaN."""
    return ~(determinant(J) > 0)


def isometric_distortion(J: Jacobian) -> Density:
    """D = max(σ₁, 1/σ_d), 1 at an isometry, +∞ at a flip (the paper counts D > 10)."""
    largest, *_, smallest = singular_values(J).unbind(-1)
    return torch.where(smallest > 0, torch.maximum(largest, smallest.reciprocal()), torch.inf)


def symmetric_dirichlet(J: Jacobian, epsilon: float = 0.0) -> Density:
    """‖J‖² + ‖J⁻¹‖² = Σ σᵢ² + σᵢ⁻², 2d at an isometry (Smith and Schaefer 2015).

    Regularised: ‖J‖² + ‖cof J‖² / χ².
    """
    chi, norm = _positive_determinant(J, epsilon), _squared_norm(J)
    return _guard(norm + _squared_inverse(J, chi, norm), chi)


def arap(J: Jacobian) -> Density:
    """As-rigid-as-possible, Σ (σᵢ - 1)² = min over rotations Q of ‖J - Q‖² (Liu et al. 2008)."""
    if _shape(J) == (3, 3):
        return (singular_values(J) - 1).square().sum(-1)
    return _squared_norm(J) - 2 * _sum(J) + 2


def lscm(J: Jacobian) -> Density:
    """Conformal energy, (σ₁ - σ₂)² / 2, 0 at an unflipped similarity (Lévy et al. 2002).

    Raises:
        ValueError: J is not of a surface, (…, 2, 2) or (…, 3, 2).
    """
    if _shape(J) == (3, 3):
        raise ValueError("lscm: defined for maps of surfaces only; use mips for volumes")
    if J.shape[-2] == 2:
        return similarity_parts(J)[1].square().sum(-1) / 2
    return _sum_and_difference(J)[1].square() / 2


def mips(J: Jacobian, epsilon: float = 0.0) -> Density:
    """MIPS, 2 at a similarity: σ₁/σ₂ + σ₂/σ₁ = ‖J‖² / det J (Hormann and Greiner 2000).

    Of volumes, (‖J‖²‖J⁻¹‖² - 1) / 4 (Fu et al. 2015, eq. 10, twice).
    """
    chi = _positive_determinant(J, epsilon)
    norm = _squared_norm(J)
    if _shape(J) == (3, 3):
        return _guard((norm * _squared_inverse(J, chi, norm) - 1) / 4, chi)
    return _guard(norm / chi, chi)


def area_distortion(J: Jacobian, epsilon: float = 0.0) -> Density:
    """det J + 1 / det J, 2 where the map keeps areas or volumes.

    Regularised: (det² J + 1) / χ, which stays positive at flips (Garanzha et al. 2021, eq. 5).
    """
    chi = _positive_determinant(J, epsilon)
    return _guard((determinant(J) ** 2 + 1) / chi, chi)


def isometric_amips(
    J: Jacobian, epsilon: float = 0.0, *, exponent: float = 5.0, conformal: float = 0.5
) -> Density:
    """Isometric advanced MIPS, exp(s (α mips + (1 - α) area) / 2) (Fu et al. 2015, eq. 9).

    +∞ with zero gradient also where it exceeds the range of the dtype, as it soon does at flips.

    Args:
        J: (…, c, d) Jacobians.
        epsilon: regularisation, see the module's text.
        exponent: s; the larger, the more the worst face counts. exp(s) at an isometry.
        conformal: α, the weight of angles against areas.
    """
    mean = conformal * mips(J, epsilon) + (1 - conformal) * area_distortion(J, epsilon)
    log_energy = exponent / 2 * mean
    finite = log_energy < math.log(torch.finfo(J.dtype).max)
    return torch.where(finite, torch.where(finite, log_energy, 0).exp(), torch.inf)


# -------------------------------------------------------------------- closed forms


def _shape(J: Tensor) -> tuple[int, int]:
    """(c, d), one of the three supported."""
    require_tensor("distortion", "J", J)
    shape = (J.shape[-2], J.shape[-1]) if J.ndim >= 2 else (0, 0)
    if shape not in ((2, 2), (3, 2), (3, 3)):
        raise ValueError(
            "distortion: expected J of shape (…, 2, 2), (…, 3, 2) or (…, 3, 3), "
            f"got {tuple(J.shape)}"
        )
    return shape


def _entries(J: Tensor) -> tuple[Tensor, ...]:
    """The entries of J row by row, each contiguous: strided, arithmetic takes twice as long."""
    return J.flatten(-2).movedim(-1, 0).contiguous().unbind(0)


def _squared_norm(J: Tensor) -> Tensor:
    first, *others = (x * x for x in _entries(J))
    return sum(others, first)


def _squared_inverse(J: Tensor, chi: Tensor, norm: Tensor) -> Tensor:
    """‖cof J / χ‖², which is ‖J⁻¹‖² for χ = det J; χ² never appears, which would leave the range.

    Args:
        J: (…, c, d).
        chi: χ(det J).
        norm: ‖J‖², which is ‖cof J‖² for surfaces.
    """
    if _shape(J)[1] == 2:
        return norm / chi / chi
    a, b, c = J.unbind(-1)
    cross = torch.linalg.cross
    cofactors = torch.stack([cross(b, c), cross(c, a), cross(a, b)], dim=-1)
    return _squared_norm(cofactors / chi[..., None, None])


def _sum_and_difference(J: Tensor) -> tuple[Tensor, Tensor]:
    """σ₁ + σ₂ and σ₁ - σ₂, each without cancellation; subgradient zero where a norm vanishes."""
    if _shape(J) == (3, 2):
        return _spatial_sum_and_difference(J)
    a, b, c, d = _entries(J)
    return _length(a + d, c - b), _length(a - d, c + b)


def _sum(J: Tensor) -> Tensor:
    """σ₁ + σ₂ alone."""
    if _shape(J) == (3, 2):
        return _spatial_sum_and_difference(J)[0]
    a, b, c, d = _entries(J)
    return _length(a + d, c - b)


def _length(x: Tensor, y: Tensor) -> Tensor:
    """√(x² + y²), subgradient zero at zero."""
    return torch.linalg.vector_norm(torch.stack([x, y], dim=-1), dim=-1)


def similarity_parts(J: Tensor) -> tuple[Tensor, Tensor]:
    """J = similarity + anti-similarity, as vectors of length σ₁ + σ₂ and σ₁ - σ₂."""
    a, b, c, d = _entries(J)
    return torch.stack([a + d, c - b], dim=-1), torch.stack([a - d, c + b], dim=-1)


def _spatial_sum_and_difference(J: Tensor) -> tuple[Tensor, Tensor]:
    """First fundamental form: (σ₁ + σ₂)² = ‖J‖² + 2 det J, σ₁² - σ₂² = |(E - G, 2F)|."""
    u, v = J.unbind(-1)
    E, F, G = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    total = _sqrt(E + G + 2 * determinant(J))
    spread = torch.linalg.vector_norm(torch.stack([E - G, 2 * F], dim=-1), dim=-1)
    # A zero total means J = 0, where the difference is zero too.
    return total, torch.where(total > 0, spread / torch.where(total > 0, total, 1), 0)


def _sqrt(x: Tensor) -> Tensor:
    """√x with subgradient zero at zero."""
    return torch.where(x > 0, torch.where(x > 0, x, 1).sqrt(), 0 * x)  # NaN stays NaN


def _positive_determinant(J: Tensor, epsilon: float) -> Tensor:
    """χ(det J); for ε = 0 det J itself, and +∞ (a constant) where it is not positive."""
    require_number("distortion", "epsilon", epsilon)
    det = determinant(J)
    if epsilon > torch.finfo(J.dtype).max:
        raise ValueError(f"distortion: epsilon = {epsilon} exceeds the range of {J.dtype}")
    if epsilon == 0:
        # Infinity keeps the denominators it ends up in, and their derivatives, free of 0/0.
        return torch.where(det > 0, det, torch.inf)
    root = torch.hypot(det, torch.full_like(det, epsilon))
    # For det < 0 the sum cancels; multiply by its conjugate instead.
    inverted = det < 0
    return (
        torch.where(
            inverted, epsilon * (epsilon / torch.where(inverted, root - det, 1)), root + det
        )
        / 2
    )


def _guard(energy: Tensor, chi: Tensor) -> Tensor:
    """+∞ with zero gradient where the determinant is not positive."""
    return torch.where(chi < torch.inf, energy, torch.inf)
