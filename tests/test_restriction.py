"""Restriction of ambient matrices to tangent planes, and extension."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

import diffpoisson as dp
from tests import meshes, references
from tests.checks import LOCAL, assert_near, field

mesh = dp.Mesh(*meshes.torus())


def test_restriction_is_what_a_matrix_does_to_tangent_vectors():
    """P applied to the edges of each face, which need no frame to be known."""
    P = field(mesh, c=4)
    E = torch.from_numpy(references.edge_vectors(*meshes.torus()).astype(np.float64)).mT
    in_frame = mesh.frames.mT @ E  # edges in frame coordinates
    assert_near(dp.restrict(P, mesh.frames) @ in_frame, P @ E, LOCAL)


def test_paper_convention():
    """Equation (6): π(P) = P B, row = output coordinate."""
    P, B = field(mesh), mesh.frames
    assert_near(dp.restrict(P, B), np.einsum("tcD,tDd->tcd", P, B), LOCAL)


def test_extension_is_the_right_inverse_and_zero_along_the_normal():
    R = field(mesh, c=4, k=2)
    extended = dp.extend(R, mesh.frames)
    assert_near(dp.restrict(extended, mesh.frames), R, LOCAL)
    assert (extended @ mesh.normals[:, :, None]).abs().max() < 1e-14


def test_extending_a_restriction_projects_out_the_normal():
    P, n = field(mesh), mesh.normals[:, :, None]
    expected = P - P @ n @ n.mT
    assert_near(dp.extend(dp.restrict(P, mesh.frames), mesh.frames), expected, LOCAL)


def test_batches_dtypes_and_gradients():
    P = field(mesh, batch=(2, 3))
    expected = torch.stack([torch.stack([dp.restrict(p, mesh.frames) for p in q]) for q in P])
    assert_near(dp.restrict(P, mesh.frames), expected, LOCAL)
    assert dp.restrict(P.float(), mesh.frames).dtype == torch.float32
    assert dp.extend(expected.float(), mesh.frames).dtype == torch.float32
    small = dp.Mesh(*meshes.book())
    assert gradcheck(lambda P: dp.restrict(P, small.frames), field(small).requires_grad_())


def test_autocast_does_not_round():
    P = field(mesh).float()
    expected = dp.restrict(P, mesh.frames)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(dp.restrict(P, mesh.frames), expected)
        assert torch.equal(dp.extend(expected, mesh.frames), dp.extend(expected, mesh.frames))
        assert dp.extend(expected, mesh.frames).dtype == torch.float32


def test_without_values_there_is_a_shape():
    P, frames = (x.to("meta") for x in (field(mesh), mesh.frames))
    assert dp.restrict(P, frames).shape == (len(P), 3, 2)


@pytest.mark.parametrize("shape", [(70, 3), (69, 3, 3), (70, 3, 2)])
def test_wrong_shapes_raise(shape, unchecked):
    matrices = torch.zeros(shape, dtype=torch.float64)
    message = (
        "restrict: with frames of shape (70, 3, 2) expected matrices of shape "
        f"(…, m=70, c, D=3), got {shape}"
    )
    with pytest.raises(ValueError, match=re.escape(message)):
        dp.restrict(matrices, mesh.frames)
    with pytest.raises(ValueError, match=re.escape("(…, m=70, c, d=2), got (70, 3, 3)")):
        dp.extend(field(mesh), mesh.frames)
