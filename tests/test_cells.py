"""Closed-form geometry of single cells against Gram determinants, in exact or long arithmetic."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from diffpoisson import cells

KINDS = {"planar": (3, 2), "spatial": (3, 3), "tetrahedra": (4, 3)}
kinds = pytest.mark.parametrize("kind", KINDS)


def corners(kind: str, count: int = 50, seed: int = 0) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.standard_normal((count, *KINDS[kind])))


def edges(x: torch.Tensor) -> np.ndarray:
    return (x[:, 1:] - x[:, :1]).numpy()


@kinds
def test_measures(kind):
    x = corners(kind)
    E = edges(x)
    expected = np.sqrt(np.linalg.det(E @ E.transpose(0, 2, 1))) / (2 if x.shape[1] == 3 else 6)
    np.testing.assert_allclose(cells.measures(x), expected, rtol=1e-10)


@pytest.mark.parametrize("kind", ["planar", "tetrahedra"])
def test_determinants_are_signed(kind):
    x = corners(kind)
    np.testing.assert_allclose(cells.determinants(x), np.linalg.det(edges(x)), rtol=1e-11)
    swapped = x[:, [1, 0, *range(2, x.shape[1])]]
    np.testing.assert_allclose(cells.determinants(swapped), -cells.determinants(x), rtol=1e-11)


def test_determinants_in_space_are_normals():
    x = corners("spatial")
    np.testing.assert_allclose(cells.determinants(x), np.cross(*edges(x).transpose(1, 0, 2)))


@kinds
def test_needles_lose_no_digits(kind):
    """Against exact rational arithmetic, with two corners 1e-7 apart, far from the first."""
    x = corners(kind, 5)
    x[:, 2] = x[:, 1] + 1e-7 * x[:, 2]
    for cell in x:
        E = np.array([[Fraction(v) for v in row] for row in cell.tolist()])
        E = E[1:] - E[:1]
        gram = E @ E.T
        if len(gram) == 2:
            square = gram[0, 0] * gram[1, 1] - gram[0, 1] ** 2
        else:
            square = sum(
                gram[0, i] * (gram[1, j] * gram[2, k] - gram[1, k] * gram[2, j])
                for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
            )
        exact = np.sqrt(float(square)) / (2 if len(gram) == 2 else 6)
        # Coordinates of order one carry roundings of 1e-16 on edges of 1e-7: none is added.
        assert cells.measures(cell[None]).item() == pytest.approx(exact, rel=1e-14, abs=0)


@kinds
def test_degenerate_cells(kind):
    x = corners(kind, 12)
    assert not cells.degenerate(x).any()
    assert not cells.degenerate(x * 1e-40).any()
    x[0, 1] = x[0, 0]  # repeated corner
    x[1, 2] = x[1, 0] + 2 * (x[1, 1] - x[1, 0])  # on a line
    x[2] = x[2, :1]  # a point
    x[3, -1] = x[3, :-1].mean(0)  # in the opposite facet
    assert cells.degenerate(x)[:4].all()
    assert not cells.degenerate(x)[4:].any()


def test_flat_but_not_degenerate():
    """The threshold is that of roundings: a height of 1e-14 counts on exact coordinates."""
    triangle = torch.tensor([[[0, 0], [1, 0], [0.5, 1e-14]]], dtype=torch.float64)
    assert not cells.degenerate(triangle).any()
    triangle[0, 2, 1] = 1e-17
    assert cells.degenerate(triangle).all()
    solid = torch.tensor(
        [[[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.3, 1e-13]]], dtype=torch.float64
    )
    assert not cells.degenerate(solid).any()
    solid[0, 3, 2] = 1e-17
    assert cells.degenerate(solid).all()


@kinds
@pytest.mark.parametrize("excess", [-0.03, 0.03])
def test_degenerate_up_to_the_rounding_error_of_a_determinant(kind, excess):
    """8 units of roundoff times the lengths of the shortest edges, 16 for tetrahedra; exactly."""
    count, dim = KINDS[kind]
    u = 2.0**-53 * (1 + excess)
    if count == 3:  # edges of length 1/2 at the last corner, whose determinant is h exactly
        cell = [[0, 0, 0][:dim], [1, 0, 0][:dim], [0.5, 8 * u / 4, 0][:dim]]
    else:  # edges of length 1 at the first one
        cell = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [-0.6, -0.8, 16 * u]]
    for turn in range(count):
        turned = torch.tensor([cell], dtype=torch.float64).roll(turn, dims=1)
        assert cells.degenerate(turned).item() == (excess < 0)


@kinds
def test_frames(kind):
    x = corners(kind)
    B = cells.frames(x)
    d = x.shape[1] - 1
    torch.testing.assert_close(B.mT @ B, torch.eye(d).double().expand(len(x), d, d))
    E = torch.from_numpy(edges(x))
    torch.testing.assert_close(E @ B @ B.mT, E)  # they span the cell
    if kind == "spatial":
        normal = torch.linalg.cross(B[:, :, 0], B[:, :, 1])
        assert ((normal * cells.determinants(x)).sum(1) > 0).all()
        first = E[:, 0] / E[:, 0].norm(dim=1, keepdim=True)
        torch.testing.assert_close(B[:, :, 0], first)
    else:
        assert torch.equal(B, torch.eye(d).double().expand(len(x), d, d))


@kinds
@pytest.mark.parametrize("inverted", [False, True])
def test_hat_gradients(kind, inverted):
    """λᵢ(xⱼ) - λᵢ(x₀) = δᵢⱼ - δᵢ₀, and they sum to zero; in any orientation."""
    x = corners(kind)
    if inverted:
        x = x[:, [1, 0, *range(2, x.shape[1])]]
    B = cells.frames(x)
    g = cells.hat_gradients(x, B)
    k = x.shape[1]
    E = torch.from_numpy(edges(x)) @ B
    hats = torch.eye(k).double()
    expected = (hats[1:] - hats[:1]).expand(len(x), k - 1, k)
    torch.testing.assert_close(E @ g, expected, rtol=0, atol=1e-11)
    assert (g.sum(2).abs() <= 1e-13 * g.abs().amax((1, 2))[:, None]).all()


@kinds
@pytest.mark.parametrize("name", ["measures", "determinants", "hats"])
def test_derivatives(kind, name):
    x = corners(kind, 3, seed=1).requires_grad_()
    function = {
        "measures": cells.measures,
        "determinants": cells.determinants,
        "hats": lambda x: cells.hat_gradients(x, cells.frames(x)),
    }[name]
    assert gradcheck(function, x)
    assert gradgradcheck(function, x, rtol=1e-3, atol=1e-4)


def test_thinness_is_least_height_over_longest_edge():
    triangle = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0.5, 3**0.5 / 2, 0]]]).double()
    needle = torch.tensor([[[0.0, 0, 0], [4, 0, 0], [1, 0, 0.02]]]).double()
    corner = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]]).double()
    for cell, expected in (
        (triangle, 3**0.5 / 2),
        (needle, 0.02 / 4),
        (needle[..., [0, 2]], 0.02 / 4),
        (corner, 1 / 3**0.5 / 2**0.5),  # over the face that is no coordinate plane
    ):
        for scale in (1e-6, 1.0, 1e6):
            assert float(cells.thinness(scale * cell)) == pytest.approx(expected, rel=1e-6)
