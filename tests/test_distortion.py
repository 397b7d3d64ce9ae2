"""Distortion energies against SVD, their definitions by singular values, and finite differences."""

from __future__ import annotations

import itertools
import re

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.autograd import gradcheck, gradgradcheck

import diffpoisson as dp
from tests import meshes
from tests.checks import assert_near

#            as a function of the signed singular values
ENERGIES = {
    "symmetric_dirichlet": lambda a, b: a**2 + b**2 + a**-2 + b**-2,
    "arap": lambda a, b: (a - 1) ** 2 + (b - 1) ** 2,
    "lscm": lambda a, b: (a - b) ** 2 / 2,
    "mips": lambda a, b: a / b + b / a,
    "area_distortion": lambda a, b: a * b + 1 / (a * b),
    "isometric_amips": lambda a, b: torch.exp(2.5 * (a / b + b / a + a * b + 1 / (a * b)) / 2),
}
BARRIERS = ("symmetric_dirichlet", "mips", "area_distortion", "isometric_amips")
AT_ISOMETRY = dict(zip(ENERGIES, (4, 0, 0, 2, 2, np.exp(5)), strict=True))

energies = pytest.mark.parametrize("name", ENERGIES)
barriers = pytest.mark.parametrize("name", BARRIERS)


def rotation(angle: float) -> torch.Tensor:
    c, s = np.cos(angle), np.sin(angle)
    return torch.tensor([[c, -s], [s, c]], dtype=torch.float64)


def embedding(seed: int) -> torch.Tensor:
    """A random isometry of the plane into space."""
    return torch.from_numpy(np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 2)))[0])


def random_jacobians(c: int, count: int = 40, seed: int = 0) -> torch.Tensor:
    """Generic ones, flipped about half the time if c = 2."""
    return torch.from_numpy(np.random.default_rng(seed).standard_normal((count, c, 2)))


def svd_with_signs(J: torch.Tensor) -> torch.Tensor:
    values = torch.linalg.svdvals(J)
    if J.shape[-2] == 2:
        values[..., 1] *= torch.sign(torch.linalg.det(J))
    return values


angles = st.floats(-np.pi, np.pi)
log_values = st.floats(-3, 3)


@st.composite
def jacobians(draw, *, flips: bool = True) -> tuple[torch.Tensor, float, float]:
    """U diag(σ₁, σ₂) Vᵀ in the plane, with its signed singular values."""
    larger, smaller = sorted((10 ** draw(log_values), 10 ** draw(log_values)), reverse=True)
    if flips and draw(st.booleans()):
        smaller = -smaller
    values = torch.diag(torch.tensor([larger, smaller], dtype=torch.float64))
    return rotation(draw(angles)) @ values @ rotation(draw(angles)), larger, smaller


# ------------------------------------------------------- singular values


@pytest.mark.parametrize("c", [2, 3])
def test_singular_values_against_svd(c):
    J = random_jacobians(c, 1000)
    values = dp.singular_values(J)
    assert_near(values, svd_with_signs(J), 1e-14)
    assert (values[:, 0] >= values[:, 1].abs()).all()
    if c == 2:
        assert (values[:, 1] < 0).any()


@given(jacobians())
def test_singular_values_over_six_decades(drawn):
    """The error is relative to the largest, and the order and the sign always hold."""
    J, larger, smaller = drawn
    values = dp.singular_values(J).numpy()
    assert np.abs(values - [larger, smaller]).max() <= 1e-14 * larger
    assert values[0] >= abs(values[1])
    in_space = dp.singular_values(embedding(0) @ J).numpy()
    assert np.abs(in_space - [larger, abs(smaller)]).max() <= 1e-14 * larger


@given(jacobians())
def test_determinant(drawn):
    J, larger, smaller = drawn
    assert abs(dp.determinant(J) - larger * smaller) <= 1e-14 * larger**2
    assert abs(dp.determinant(embedding(1) @ J) - larger * abs(smaller)) <= 1e-14 * larger**2


SPECIAL = {
    "identity": torch.eye(2).double(),
    "rotation": rotation(0.7),
    "half turn": -torch.eye(2).double(),
    "similarity": 3 * rotation(2.0),
    "reflection": torch.diag(torch.tensor([1.0, -1.0])).double(),
    "scaled reflection": 2 * rotation(1.0) @ torch.diag(torch.tensor([1.0, -1.0])).double(),
    "rank one": torch.ones(2, 2).double(),
    "rank one, axis": torch.diag(torch.tensor([1.0, 0.0])).double(),
    "zero": torch.zeros(2, 2).double(),
    "embedding": embedding(0),
    "flat embedding": torch.eye(3, 2).double(),
    "rank one in space": torch.ones(3, 2).double(),
    "zero in space": torch.zeros(3, 2).double(),
}
special = pytest.mark.parametrize("J", SPECIAL.values(), ids=SPECIAL)


@special
def test_singular_values_where_they_repeat_or_vanish(J):
    """Right values, and finite gradients where `torch.linalg.svd` has none."""
    assert (dp.singular_values(J) - svd_with_signs(J)).abs().max() < 1e-15 * 4
    for index in (0, 1):
        leaf = J.clone().requires_grad_()
        dp.singular_values(leaf)[index].backward()
        assert leaf.grad.isfinite().all()
        assert leaf.grad.norm() <= 1 + 1e-12  # singular values are 1-Lipschitz


@special
@pytest.mark.parametrize("name", [*ENERGIES, "determinant"])
@pytest.mark.parametrize("epsilon", [0.0, 0.1])
def test_gradients_are_finite_everywhere(J, name, epsilon):
    energy = getattr(dp, name)
    leaf = J.clone().requires_grad_()
    value = energy(leaf, epsilon) if name in BARRIERS else energy(leaf)
    value.backward()
    assert leaf.grad.isfinite().all()
    assert not value.isnan()


# ------------------------------------------------------- energies


@energies
@pytest.mark.parametrize("c", [2, 3])
def test_energies_by_singular_values(name, c):
    J = random_jacobians(c, 200)
    values = svd_with_signs(J)
    keep = (values[:, 1] > 0.2) if name in BARRIERS else slice(None)
    expected = ENERGIES[name](*values[keep].unbind(-1))
    torch.testing.assert_close(getattr(dp, name)(J[keep]), expected, rtol=1e-11, atol=1e-13)


@energies
@given(jacobians(flips=False))
def test_energies_over_six_decades(name, drawn):
    J, larger, smaller = drawn
    expected = ENERGIES[name](*torch.tensor([larger, smaller], dtype=torch.float64))
    # Roundings of J are relative to its largest entry; σ₂ feels them σ₁/σ₂ times more.
    condition = larger / smaller
    value = getattr(dp, name)(J)
    if name == "isometric_amips":
        value, expected = value.log(), expected.log()
    scale = 1 + larger**2 if name in ("arap", "lscm") else expected
    assert value == expected or abs(value - expected) <= 1e-14 * condition**2 * scale


@energies
def test_values_at_isometries(name):
    J = torch.stack([SPECIAL["identity"], SPECIAL["rotation"], SPECIAL["half turn"]])
    torch.testing.assert_close(getattr(dp, name)(J), torch.full((3,), AT_ISOMETRY[name]).double())
    torch.testing.assert_close(getattr(dp, name)(embedding(3)).item(), float(AT_ISOMETRY[name]))


@energies
def test_isometries_are_minima(name):
    J = rotation(0.3).requires_grad_()
    energy = getattr(dp, name)
    energy(J).backward()
    assert J.grad.abs().max() < 1e-12 * energy(J).item() + 1e-12
    nearby = J.detach() + 1e-3 * random_jacobians(2)
    assert (energy(nearby) >= energy(J).detach() * (1 - 1e-12)).all()


@pytest.mark.parametrize("name", [*ENERGIES, "isometric_distortion", "singular_values"])
@given(jacobians(), angles, angles)
def test_invariance_to_rotations(name, drawn, left, right):
    J, larger, smaller = drawn
    energy = getattr(dp, name)
    expected, turned = energy(J), energy(rotation(left) @ J @ rotation(right))
    condition = larger / abs(smaller)
    if name == "isometric_amips":
        expected, turned = expected.log(), turned.log()
    scale = larger**2 + 1 if name in ("arap", "lscm") else expected.abs()
    if name == "singular_values":
        scale = larger
    equal = expected == turned
    assert (equal | ((turned - expected).abs() <= 1e-13 * condition**2 * scale)).all()


def test_arap_keeps_its_digits_beside_a_reflection():
    """σ₁ + σ₂ = 1e-9 there, of which the root of a difference of squares would leave nothing."""
    J = torch.diag(torch.tensor([1, 1e-9 - 1], dtype=torch.float64))
    assert_near(dp.arap(J), torch.tensor((2 - 1e-9) ** 2, dtype=torch.float64), 1e-15)


def test_arap_is_the_distance_to_the_nearest_rotation():
    """In the plane: proper rotations only, so that flips cost; in space: isometric embeddings."""
    for c in (2, 3):
        J = random_jacobians(c)
        U, _, Vt = np.linalg.svd(J.numpy(), full_matrices=False)
        if c == 2:
            U[:, :, 1] *= np.sign(np.linalg.det(U @ Vt))[:, None]
        expected = ((J.numpy() - U @ Vt) ** 2).sum((1, 2))
        assert_near(dp.arap(J), expected, 1e-14)
        sampled = [rotation(a) for a in np.linspace(0, 2 * np.pi, 400)] if c == 2 else []
        for Q in sampled:
            assert (((J - Q) ** 2).sum((1, 2)) >= dp.arap(J) - 1e-12).all()


def test_closest_rotation_is_the_polar_factor():
    J = random_jacobians(2).reshape(4, 10, 2, 2)
    U, _, Vt = np.linalg.svd(J.numpy())
    U[..., 1] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    Q = dp.closest_rotation(J)
    assert_near(Q, U @ Vt, 1e-13)
    leaf = J[0].clone().requires_grad_()
    assert gradcheck(dp.closest_rotation, leaf)
    assert gradgradcheck(dp.closest_rotation, leaf)


@pytest.mark.parametrize("scale", [1e-290, 1e-158, 1e-3, 1e3, 1e158, 1e290])
def test_scale_does_not_turn_the_closest_rotation(scale):
    """Where squares leave the range, too; the derivative is that for the scaled direction."""
    J, v = random_jacobians(2), random_jacobians(2, seed=1)
    expected = torch.func.jvp(dp.closest_rotation, (J,), (v,))
    found = torch.func.jvp(dp.closest_rotation, (scale * J,), (scale * v,))
    for a, b in zip(found, expected, strict=True):
        assert_near(a, b, 1e-13)
    gradients = []
    for size in (1.0, scale):
        leaf = (size * J).requires_grad_()
        gradients.append(size * torch.autograd.grad(dp.closest_rotation(leaf), leaf, v)[0])
    assert_near(gradients[1], gradients[0], 1e-13)


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_what_is_not_finite_has_no_closest_rotation(value):
    J = random_jacobians(2, 3)
    expected = dp.closest_rotation(J)[::2]
    J[1, 0, 1] = value
    Q = dp.closest_rotation(J)
    assert Q[1].isnan().all()
    assert torch.equal(Q[::2], expected)


@given(jacobians(), angles)
def test_no_rotation_is_closer(drawn, angle):
    J = drawn[0]
    distance = torch.linalg.vector_norm(J - dp.closest_rotation(J))
    assert distance <= torch.linalg.vector_norm(J - rotation(angle)) * (1 + 1e-12)


def test_where_all_rotations_are_equally_close_the_identity_is_taken():
    J = torch.tensor([[[1.0, 0.0], [0.0, -1.0]], [[0.0, 0.0], [0.0, 0.0]]], requires_grad=True)
    Q = dp.closest_rotation(J)
    assert_near(Q.detach(), torch.eye(2).expand(2, 2, 2), 0)
    (derivative,) = torch.autograd.grad(Q.square().sum() + Q.sum(), J)
    assert_near(derivative, torch.zeros(2, 2, 2), 0)


def test_lscm_is_the_cauchy_riemann_residual():
    J = random_jacobians(2)
    ux, uy, vx, vy = J.flatten(1).unbind(1)
    assert_near(dp.lscm(J), ((ux - vy) ** 2 + (uy + vx) ** 2) / 2, 1e-15)


def test_amips_parameters():
    J = random_jacobians(3)
    for s, alpha in itertools.product((1.0, 3.0), (0.0, 0.3, 1.0)):
        expected = torch.exp(s / 2 * (alpha * dp.mips(J) + (1 - alpha) * dp.area_distortion(J)))
        actual = dp.isometric_amips(J, exponent=s, conformal=alpha)
        torch.testing.assert_close(actual, expected, rtol=1e-13, atol=0)


# ------------------------------------------------------- flips


@given(jacobians())
def test_flipped(drawn):
    J, _, smaller = drawn
    assert dp.flipped(J).item() == (smaller < 0)


@given(jacobians())
def test_isometric_distortion(drawn):
    J, larger, smaller = drawn
    actual = dp.isometric_distortion(J)
    if smaller < 0:
        assert actual == torch.inf
    else:
        expected = max(larger, 1 / smaller)
        assert abs(actual - expected) <= 1e-13 * larger / smaller * expected


def test_collapsed_faces_count_as_flipped():
    J = torch.stack([SPECIAL["zero"], SPECIAL["rank one"], SPECIAL["rank one, axis"]])
    assert dp.flipped(J).all()
    assert (dp.isometric_distortion(J) == torch.inf).all()
    assert dp.flipped(torch.zeros(2, 3, 2)).all()
    assert dp.flipped(J).dtype == torch.bool


@barriers
def test_flips_cost_infinity_with_zero_gradient(name):
    flips = [SPECIAL[k] for k in ("reflection", "scaled reflection", "zero", "rank one, axis")]
    J = torch.stack([*flips, torch.eye(2).double() * 2]).requires_grad_()
    energy = getattr(dp, name)(J)
    assert (energy[:4] == torch.inf).all()
    assert energy[4].isfinite()
    energy[:4].sum().backward()
    assert (J.grad == 0).all()
    J.grad = None
    energy = getattr(dp, name)(J)
    energy.sum().backward()  # one flipped face does not spoil the others' gradients
    (alone,) = torch.autograd.grad(getattr(dp, name)(J[4]), J)
    assert torch.equal(J.grad, alone)


@barriers
@pytest.mark.parametrize("c", [2, 3])
def test_regularised_tends_to_unregularised(name, c):
    """χ = det + ε²/4det + …: the difference vanishes with ε²."""
    J = random_jacobians(c, 200)
    J = J[dp.singular_values(J)[:, 1] > 0.3]
    values = [getattr(dp, name)(J, epsilon) for epsilon in (0.0, 1e-3, 1e-4, 1e-7)]
    exact, coarse, fine, finest = (v.log() if name == "isometric_amips" else v for v in values)
    assert ((fine - exact).abs() <= 0.0101 * (coarse - exact).abs() + 1e-13 * exact).all()
    assert ((finest - exact).abs() <= 1e-11 * exact).all()
    assert ((coarse - exact).abs() > 1e-9 * exact).any()


@barriers
@pytest.mark.parametrize("epsilon", [0.03, 0.3, 1.0])
def test_regularised_pushes_flips_back(name, epsilon):
    """Finite, and descent increases the determinant of every flipped or collapsed face."""
    J = random_jacobians(2, 200)
    J = torch.cat([J[dp.determinant(J) < 0], 1e-3 * J[:3]])
    if name == "isometric_amips":
        J = 0.1 * J  # the exponential leaves float64's range soon
    J.requires_grad_()
    energy = getattr(dp, name)(J, epsilon)
    energy = energy if name != "isometric_amips" else energy.log()
    (slope,) = torch.autograd.grad(energy.sum(), J)
    (towards_positive,) = torch.autograd.grad(dp.determinant(J).sum(), J)
    keep = energy.isfinite()
    assert keep.sum() > len(J) // 2
    assert keep.all() or name == "isometric_amips"
    assert ((slope * towards_positive).sum((1, 2))[keep & (dp.determinant(J) <= 0)] < 0).all()
    assert (energy > 0).all()


def test_regularised_determinant_does_not_cancel():
    """χ(-1e6) with ε = 1e-3 is 2.5e-13; the textbook form rounds it to zero."""
    J = torch.diag(torch.tensor([1e3, -1e3], dtype=torch.float64))
    chi = 2e6 / dp.mips(J, 1e-3)  # mips is ‖J‖²/χ
    assert chi.item() == pytest.approx(2.5e-13, rel=1e-12, abs=0)


def test_epsilon_up_to_the_range_of_the_dtype():
    J, largest = torch.eye(2), torch.finfo(torch.float32).max
    assert_near(dp.area_distortion(J, largest), torch.tensor(4 / largest), 1e-6)
    with pytest.raises(ValueError, match=r"epsilon = 6\.8\S+ exceeds the range of torch\.float32"):
        dp.area_distortion(J, 2 * largest)


def test_negative_epsilon_raises(unchecked):
    for name in BARRIERS:
        with pytest.raises(ValueError, match="epsilon must be finite and not negative, got -1"):
            getattr(dp, name)(torch.eye(2), -1.0)


# ------------------------------------------------------- derivatives


@pytest.mark.parametrize("c", [2, 3])
@pytest.mark.parametrize("name", [*ENERGIES, "singular_values", "determinant"])
@pytest.mark.parametrize("epsilon", [0.0, 0.3])
def test_derivatives(name, c, epsilon):
    """First and second, against finite differences, at generic unflipped and flipped faces."""
    J = 0.3 * random_jacobians(c, 6, seed=4) + torch.eye(c, 2)
    if name not in BARRIERS or epsilon:
        J[::2] = J[::2].flip(-1)
    energy = getattr(dp, name)

    def function(J):
        value = energy(J, epsilon) if name in BARRIERS else energy(J)
        return value.log() if name == "isometric_amips" else value

    assert gradcheck(function, J.requires_grad_(), rtol=1e-5)
    assert gradgradcheck(function, J, rtol=1e-4, atol=1e-4)


def test_second_derivatives_at_isometries():
    """At a rotation Q, of Q (1 + E): those of ‖sym E‖² and, without its trace, of conformal ones.

    There σ₁ - σ₂, of which `lscm` is a square, has a kink.
    """
    Q, E = rotation(0.7), random_jacobians(2)
    sym = (E + E.mT) / 2
    traceless = sym - sym.diagonal(dim1=1, dim2=2).mean(1)[:, None, None] * torch.eye(2)
    for energy, part in ((dp.arap, sym), (dp.lscm, traceless)):
        t = torch.zeros(len(E), dtype=torch.float64, requires_grad=True)
        value = energy(Q @ (torch.eye(2) + t[:, None, None] * E))
        (first,) = torch.autograd.grad(value.sum(), t, create_graph=True)
        (second,) = torch.autograd.grad(first.sum(), t)
        assert_near(second, 2 * part.square().sum((1, 2)), 1e-13)


# ------------------------------------------------------- shapes and dtypes

EVERY = [*ENERGIES, "determinant", "flipped", "isometric_distortion", "singular_values"]


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("batch", [(), (5,), (2, 0), (2, 3, 4)])
@pytest.mark.parametrize("c", [2, 3])
def test_batches(name, batch, c):
    function = getattr(dp, name)
    J = torch.from_numpy(np.random.default_rng(0).standard_normal((*batch, c, 2)))
    values = function(J)
    assert values.shape == ((*batch, 2) if name == "singular_values" else batch)
    for index in np.ndindex(*batch):
        assert torch.equal(values[index], function(J[index]))
    assert function(J.float()).dtype == (torch.bool if name == "flipped" else torch.float32)


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("shape", [(2,), (4, 2), (5, 2, 3), (1, 2)])
def test_wrong_shapes_raise(name, shape, unchecked):
    message = f"distortion: expected J of shape (…, 2, 2), (…, 3, 2) or (…, 3, 3), got {shape}"
    with pytest.raises(ValueError, match=re.escape(message)):
        getattr(dp, name)(torch.ones(shape))


# ------------------------------------------------------- volumes

#            as a function of the signed singular values
VOLUME_ENERGIES = {
    "symmetric_dirichlet": lambda s: (s**2 + s**-2).sum(-1),
    "arap": lambda s: ((s - 1) ** 2).sum(-1),
    "mips": lambda s: ((s**2).sum(-1) * (s**-2).sum(-1) - 1) / 4,
    "area_distortion": lambda s: s.prod(-1) + 1 / s.prod(-1),
    "isometric_amips": lambda s: torch.exp(
        5 / 4 * (((s**2).sum(-1) * (s**-2).sum(-1) - 1) / 4 + s.prod(-1) + 1 / s.prod(-1))
    ),
}
AT_VOLUME_ISOMETRY = dict(zip(VOLUME_ENERGIES, (6, 0, 2, 2, np.exp(5)), strict=True))
volume_energies = pytest.mark.parametrize("name", VOLUME_ENERGIES)


def rotation_in_space(seed: int) -> torch.Tensor:
    return torch.from_numpy(meshes.rotation(np.random.default_rng(seed), np.zeros((1, 3))))


def volume_jacobians(values: torch.Tensor, seed: int = 0) -> torch.Tensor:
    """U diag(s) Vᵀ with random rotations."""
    U, V = (
        torch.stack([rotation_in_space(seed + 1000 * side + i) for i in range(len(values))])
        for side in (1, 2)
    )
    return U @ torch.diag_embed(values) @ V.mT


def random_values(count: int, *, flips: bool, seed: int = 0) -> torch.Tensor:
    """Descending, between 0.1 and 10, the last one negative about half the time."""
    rng = np.random.default_rng(seed)
    values = np.sort(10 ** rng.uniform(-1, 1, (count, 3)), axis=1)[:, ::-1].copy()
    if flips:
        values[:, 2] *= rng.choice([-1, 1], count)
    return torch.from_numpy(values)


@pytest.mark.parametrize("size", [1e-120, 1e-30, 1e120])
def test_the_sign_of_a_volume_does_not_depend_on_its_size(size):
    """Where the determinant itself would under- or overflow."""
    dtype = torch.float32 if size == 1e-30 else torch.float64
    J = size * torch.diag_embed(torch.tensor([[2.0, 1, -1], [3, 2, 1]], dtype=dtype))
    expected = size * torch.tensor([[2.0, 1, -1], [3, 2, 1]], dtype=dtype)
    torch.testing.assert_close(dp.singular_values(J), expected, rtol=1e-6, atol=0)


def test_singular_values_of_volumes():
    """As constructed, by the number and by LAPACK; the sign is that of the determinant."""
    values = random_values(100, flips=True)
    J = volume_jacobians(values)
    assert_near(dp.singular_values(J), values, 1e-14)
    assert_near(dp.singular_values(J).abs(), torch.linalg.svdvals(J), 1e-15)
    assert_near(dp.determinant(J), values.prod(1), 1e-13)
    assert torch.equal(dp.flipped(J), values[:, 2] < 0)
    expected = torch.where(
        values[:, 2] > 0, torch.maximum(values[:, 0], 1 / values[:, 2]), torch.inf
    )
    torch.testing.assert_close(dp.isometric_distortion(J), expected, rtol=1e-12, atol=0)


@volume_energies
def test_energies_of_volumes_by_singular_values(name):
    values = random_values(100, flips=name == "arap")
    value = getattr(dp, name)(volume_jacobians(values))
    expected = VOLUME_ENERGIES[name](values)
    if name == "isometric_amips":
        value, expected = value.log(), expected.log()
    torch.testing.assert_close(value, expected, rtol=1e-10, atol=1e-13)


@volume_energies
def test_volumes_at_isometries(name):
    J = torch.stack([torch.eye(3).double(), rotation_in_space(3)])
    expected = torch.full((2,), AT_VOLUME_ISOMETRY[name], dtype=torch.float64)
    torch.testing.assert_close(getattr(dp, name)(J), expected, rtol=1e-13, atol=1e-14)
    nearby = J[1] + 1e-3 * torch.from_numpy(np.random.default_rng(0).standard_normal((50, 3, 3)))
    assert (getattr(dp, name)(nearby) >= expected[0] * (1 - 1e-12)).all()


def test_arap_of_volumes_is_the_distance_to_the_nearest_rotation():
    J = torch.from_numpy(np.random.default_rng(0).standard_normal((100, 3, 3)))
    U, _, Vt = np.linalg.svd(J.numpy())
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    assert_near(dp.arap(J), ((J.numpy() - U @ Vt) ** 2).sum((1, 2)), 1e-14)


@pytest.mark.parametrize("name", [*VOLUME_ENERGIES, "singular_values", "determinant"])
@pytest.mark.parametrize("epsilon", [0.0, 0.3])
def test_derivatives_of_volumes(name, epsilon):
    exponential = name == "isometric_amips"  # leaves float64's range at flips
    values = random_values(4, flips=not exponential and (epsilon or name not in BARRIERS), seed=2)
    J = volume_jacobians(values)
    energy = getattr(dp, name)

    def function(J):
        value = energy(J, epsilon) if name in BARRIERS else energy(J)
        return value.log() if name == "isometric_amips" else value

    assert gradcheck(function, J.requires_grad_(), rtol=1e-4, atol=1e-4)
    assert gradgradcheck(function, J, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("name", [*VOLUME_ENERGIES, "singular_values", "determinant"])
def test_gradients_of_volumes_where_values_repeat_or_vanish(name):
    """Finite, where `torch.linalg.svd` has none: isometries above all."""
    energy = getattr(dp, name)
    for values in ((1.0, 1, 1), (2, 2, 1), (2, 1, 1), (3, 3, -3), (1, 1, 0), (1, 0, 0), (0, 0, 0)):
        J = volume_jacobians(torch.tensor([values], dtype=torch.float64)).requires_grad_()
        value = energy(J)
        value.sum().backward()
        assert J.grad.isfinite().all(), values
        assert not value.isnan().any()
        if values == (1, 1, 1) and name in VOLUME_ENERGIES:
            assert J.grad.abs().max() < 1e-10 * max(1, value.item())


@pytest.mark.parametrize("name", BARRIERS)
def test_flipped_volumes(name):
    """Infinite with zero gradient; regularised, descent increases the determinant."""
    values = random_values(30, flips=False)
    values[:, 2] *= -1
    J = volume_jacobians(0.1 * values).requires_grad_()
    energy = getattr(dp, name)
    (slope,) = torch.autograd.grad(energy(J).sum(), J)
    assert (energy(J) == torch.inf).all()
    assert (slope == 0).all()
    value = energy(J, 0.5)
    value = value.log() if name == "isometric_amips" else value
    (slope,) = torch.autograd.grad(value.sum(), J)
    (towards_positive,) = torch.autograd.grad(dp.determinant(J).sum(), J)
    assert value.isfinite().all()
    assert ((slope * towards_positive).sum((1, 2)) < 0).all()


def test_volumes_that_are_not_finite_spoil_no_others():
    """One NaN anywhere leaves no singular value of its cell, and those of the others alone."""
    J = volume_jacobians(random_values(9, flips=True))
    expected = dp.singular_values(J)
    for bad in range(9):
        spoiled = J.clone()
        spoiled[bad].view(-1)[bad] = torch.nan
        values = dp.singular_values(spoiled)
        assert values[bad].isnan().all()
        values[bad] = expected[bad]
        assert torch.equal(values, expected)


def test_singular_values_of_tiny_volumes():
    """Whose determinant is too small for float64."""
    J = 1e-200 * volume_jacobians(random_values(5, flips=False))
    assert_near(dp.singular_values(J), torch.linalg.svdvals(J), 1e-14)


def test_singular_values_of_volumes_are_not_of_half_precision():
    with pytest.raises(TypeError, match=r"singular_values: J must be float32 or float64, got"):
        dp.singular_values(torch.eye(3).half())


def test_lscm_is_for_surfaces(unchecked):
    with pytest.raises(ValueError, match="lscm: defined for maps of surfaces only; use mips"):
        dp.lscm(torch.eye(3))


@pytest.mark.parametrize("batch", [(), (5,), (2, 0), (2, 3)])
def test_batches_of_volumes(batch):
    J = torch.from_numpy(np.random.default_rng(0).standard_normal((*batch, 3, 3)))
    for name in [*VOLUME_ENERGIES, "determinant", "flipped", "isometric_distortion"]:
        values = getattr(dp, name)(J)
        assert values.shape == batch
        for index in np.ndindex(*batch):
            assert torch.equal(values[index], getattr(dp, name)(J[index]))
    assert dp.singular_values(J).shape == (*batch, 3)
