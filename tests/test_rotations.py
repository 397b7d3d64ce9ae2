"""The closest rotation in space at every scale, shape and dtype, and where it is not unique.

The basic properties are in `map_checks.py`.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.linalg
import torch
from torch.func import jvp

import diffpoisson as dp
from tests.checks import assert_near
from tests.map_checks import aligned, matrices, of_signed_values, turning

dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


# ------------------------------------------------------- values


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("shape", [(), (0,), (40,), (2, 1, 5)])
def test_closest_rotation_is_scipys(d, shape):
    J = matrices(d, int(np.prod(shape))).reshape(*shape, 3, d)
    Q = dp.closest_rotation(J)
    assert_near(Q, aligned(J), 1e-13)
    assert_near(Q.mT @ Q, torch.eye(d, dtype=torch.float64).expand(*shape, d, d), 1e-14)
    assert_near(((J - Q) ** 2).sum((-2, -1)), dp.arap(J), 1e-13)
    if d == 3:
        assert_near(torch.linalg.det(Q), np.ones(shape), 1e-14)


def test_of_positive_determinant_it_is_the_polar_factor():
    J = matrices()
    for matrix in J[torch.linalg.det(J) > 0]:
        assert_near(dp.closest_rotation(matrix), scipy.linalg.polar(matrix.numpy())[0], 1e-13)


def test_flips_of_every_sign_along_the_axes():
    """Zeros everywhere; the smallest axis turns back, where the determinant is negative."""
    signs = itertools.product((1, -1), repeat=3)
    J = torch.stack(
        [
            torch.diag(torch.tensor([3.0, 2.0, 1.0]) * torch.tensor(sign))[list(order)]
            for sign in signs
            for order in itertools.permutations(range(3))
        ]
    )
    expected = J.sign()
    expected[J.abs() == 1] *= torch.linalg.det(J).sign()
    assert_near(dp.closest_rotation(J), expected, 1e-6)
    assert_near(expected, aligned(J), 1e-6)


@pytest.mark.parametrize(
    ("dtype", "scales"), [(torch.float64, (-150, 150)), (torch.float32, (-30, 30))]
)
def test_scale_does_not_count(dtype, scales):
    J = matrices()
    for scale in scales:
        assert_near(dp.closest_rotation((10.0**scale * J).to(dtype)), aligned(J), 2e-5)
    assert dp.closest_rotation(J.to(dtype)).dtype == dtype


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("place", [(0, 0), (2, 1)])
def test_what_is_not_finite_spoils_no_other(d, value, place):
    J = matrices(d, 3)
    clean = J.clone()
    J[1][place] = value
    J.requires_grad_(), clean.requires_grad_()
    Q, expected = dp.closest_rotation(J), dp.closest_rotation(clean)
    assert Q[1].isnan().all()
    assert torch.equal(Q[::2], expected[::2])
    (found,) = torch.autograd.grad((Q[::2] ** 3).sum(), J)
    (right,) = torch.autograd.grad((expected[::2] ** 3).sum(), clean)
    assert torch.equal(found[::2], right[::2])


# ------------------------------------------------------- derivatives


@pytest.mark.parametrize(
    ("dtype", "scale"),
    [
        *((torch.float64, scale) for scale in (1e-150, 0.01, 1.0, 100.0, 1e150)),
        *((torch.float32, scale) for scale in (1e-18, 1.0, 1e18)),
    ],
)
def test_derivative_at_every_scale(dtype, scale):
    """Scaled J and direction: the same derivative. Half of these are flipped; one is negative."""
    J, v = matrices(n=12), matrices(n=12, seed=1)
    J[0] = -J[0].abs()
    assert 0 < int((torch.linalg.det(J) < 0).sum()) < len(J)
    _, found = jvp(dp.closest_rotation, ((scale * J).to(dtype),), ((scale * v).to(dtype),))
    expected = np.stack([turning(*pair) for pair in zip(J, v, strict=True)])
    assert_near(found, expected, 1e-11 if dtype == torch.float64 else 1e-3)


@pytest.mark.parametrize("d", [2, 3])
def test_derivatives_against_differences(d):
    """Where singular values meet, too: at a rotation, where those of singular vectors are NaN."""
    J = torch.cat([matrices(d, 4), torch.eye(3, dtype=torch.float64)[None, :, :d]])
    J.requires_grad_()
    assert torch.autograd.gradcheck(dp.closest_rotation, J, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(dp.closest_rotation, J)


# ------------------------------------------------------- where several are closest


@dtypes
@pytest.mark.parametrize("ratio", [0.0, 1e-8, 0.3, 1.0])
def test_where_several_are_closest_the_derivative_is_zero(dtype, ratio):
    """σ₂ + σ₃ = 0 but for rounding: rank one, and reflections; of many none gets by."""
    n = 5000
    values = torch.tensor([[1, ratio, -ratio]], dtype=torch.float64).expand(n, 3)
    J = of_signed_values(values).to(dtype).requires_grad_()
    Q = dp.closest_rotation(J)
    eps = torch.finfo(dtype).eps
    assert_near(((J - Q) ** 2).sum((-2, -1)).detach(), dp.arap(J).detach(), 40 * eps)
    (derivative,) = torch.autograd.grad((Q**3).sum(), J)
    assert not derivative.any()


@pytest.mark.parametrize("d", [2, 3])
@dtypes
def test_of_nothing_the_derivative_is_zero(d, dtype):
    J = torch.zeros(2, 3, d, dtype=dtype, requires_grad=True)
    Q = dp.closest_rotation(J)
    assert_near((Q.mT @ Q).detach(), torch.eye(d).expand(2, d, d), 1e-6)
    (derivative,) = torch.autograd.grad((Q**3).sum(), J)
    assert not derivative.any()


@dtypes
@pytest.mark.parametrize("flat", [False, True])
def test_just_above_the_bound_of_rounding_there_is_a_derivative(dtype, flat):
    """det K = (σ₁ + σ₂)(σ₁ + σ₃)(σ₂ + σ₃) on either side of 30 roundings of its third power.

    The largest entry of K is σ₁ + σ₂, near one in the one case; in the other, where no entry of the
    rotation is above 2/3, near three.
    """
    eps = torch.finfo(dtype).eps
    U = torch.eye(3, dtype=torch.float64)
    U = 2 / 3 - U if flat else U
    s1, s2 = (1.5, 1.35) if flat else (1.0, 0.01)
    largest = s1 + s2
    for share, unique in ((0.6, False), (1.6, True)):
        gap = share * 30 * eps * largest**3 / (largest * (s1 - s2))
        J = U * torch.tensor([s1, s2, gap - s2], dtype=torch.float64)
        about_first = torch.tensor([[0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=dtype)
        J = J.to(dtype)
        Q, found = jvp(dp.closest_rotation, (J,), (dp.closest_rotation(J) @ about_first,))
        expected = 2 / gap * Q @ about_first if unique else torch.zeros_like(Q)
        assert_near(found, expected, 0.3)


@pytest.mark.parametrize("shape", [(4, 2, 2), (4, 3, 2), (4, 3, 3)])
def test_without_values_there_is_a_shape(shape):
    """On the meta device, which has no autocast."""
    assert dp.closest_rotation(torch.zeros(shape, device="meta")).shape == shape


def test_shapes_and_dtypes_it_refuses(unchecked):
    with pytest.raises(ValueError, match=r"expected J of shape"):
        dp.closest_rotation(torch.zeros(5, 2, 3))
    for d in (2, 3):
        with pytest.raises(TypeError, match="closest_rotation: J must be"):
            dp.closest_rotation(torch.zeros(5, 3, d, dtype=torch.float16))
