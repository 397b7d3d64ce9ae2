"""The rotation closest to a 3 × 3 matrix, differentiably and under every torch transform.

Q minimises ‖J - Q‖ over rotations exactly where QᵀJ is symmetric (and tr QᵀJ largest). Turned to
Q exp [ω]×, with S the symmetric part of QᵀJ, it is so up to second order in ω for

    (tr S - S) ω = axial(QᵀJ),    axial(A) = (A₃₂ - A₂₃, A₁₃ - A₃₁, A₂₁ - A₁₂),

which is Newton's step. Singular vectors, whose derivatives are infinite where singular values meet,
give Q as a constant; then ω = 0, but its derivative is that of the closest rotation. A second step
makes it exact to third order, as Newton's method squares what the first misses.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from diffpoisson.transforms import without_autocast

_STEPS = 2  # k of them give derivatives up to order 2ᵏ - 1

Matrices = Float[Tensor, "*batch 3 3"]


def nearest_rotation(J: Matrices) -> Matrices:
    """The rotation closest to each matrix; where several are, one of them, with derivative zero.

    Several are where σ₂ + σ₃ = 0, with σ₃ signed: for matrices of rank one, reflections, and the
    like. That is taken to be so where it can't be told from zero in the dtype. NaN where J is not
    finite. Derivatives are exact up to third order.
    """
    size = J.detach().abs().amax((-2, -1), keepdim=True)  # NaN or infinite if any entry is
    J = J / torch.where(size > 0, size, 1)
    with without_autocast(J.device):
        # LAPACK refuses the whole batch for one NaN.
        Q = _by_singular_vectors(J.detach().nan_to_num())
        Q = torch.where(size.isfinite(), Q, torch.nan)
        for _ in range(_STEPS):
            Q = Q @ _cayley(_newton(Q.mT @ J))
    return Q


def _by_singular_vectors(J: Matrices) -> Matrices:
    """U diag(1, 1, det UVᵀ) Vᵀ."""
    U, _, Vt = torch.linalg.svd(J)
    sign = _determinant(U @ Vt).sign()
    return torch.cat([U[..., :2], sign[..., None, None] * U[..., 2:]], dim=-1) @ Vt


def _newton(A: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """ω for A = QᵀJ, whose largest singular value is between 1/3 and 3; zero if Q is not unique."""
    S = (A + A.mT) / 2
    trace = S.diagonal(dim1=-2, dim2=-1).sum(-1)
    K = trace[..., None, None] * torch.eye(3).to(S) - S  # of eigenvalues σᵢ + σⱼ
    a, b, c = K.unbind(-1)
    cofactors = torch.stack(
        [torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=-2
    )
    determinant = (a * cofactors[..., 0, :]).sum(-1)
    # Each entry of K is right to some ten roundings of σ₁, and no eigenvalue is above 2 σ₁: so much
    # may be left of det K = (σ₁ + σ₂)(σ₁ + σ₃)(σ₂ + σ₃) where σ₂ + σ₃ vanishes.
    largest = K.amax((-2, -1))  # of a semidefinite matrix, on the diagonal
    unique = determinant > 30 * torch.finfo(S.dtype).eps * largest**3
    axial = torch.stack([A[..., i, j] - A[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], dim=-1)
    omega = (cofactors @ axial[..., None])[..., 0] / torch.where(unique, determinant, 1)[..., None]
    return torch.where(unique[..., None], omega, 0)


def _cayley(omega: Float[Tensor, "*batch 3"]) -> Matrices:
    """(1 - [ω/2]×)⁻¹ (1 + [ω/2]×), the rotation that is exp [ω]× up to third order in ω."""
    x, y, z = omega.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    turned = cross + cross @ cross / 2
    return torch.eye(3).to(omega) + turned / (1 + omega.square().sum(-1) / 4)[..., None, None]


def _determinant(A: Matrices) -> Float[Tensor, "*batch"]:
    return (torch.linalg.cross(A[..., 0], A[..., 1]) * A[..., 2]).sum(-1)
