"""Losses of a predicted map: distance to a target map, and distortion, which needs no target."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

import diffpoisson as dp
from njf_models.features import Shape
from njf_models.njf import Prediction, centre_areas, centre_vertices

VERTEX_WEIGHT = 10.0  # λ of the paper's eq. 8; the authors' experiments use it too


Reduction = Literal["mean", "none"]


class Loss(NamedTuple):
    """A weighted sum and its terms: averaged over the batch, or (…, parts) if not reduced."""

    total: Float[Tensor, "*batch"]
    vertices: Float[Tensor, "*batch"]
    jacobians: Float[Tensor, "*batch"]


def paper_loss(
    shape: Shape,
    prediction: Prediction,
    target: Float[Tensor, "*#batch n c"],
    reduction: Reduction = "mean",
) -> Loss:
    """10 Σ |Vⱼ| ‖Φⱼ - Ψⱼ‖² + Σ |tⱼ| ‖Rⱼ - Jⱼ‖² at unit total area, averaged over the shapes.

    Areas enter as shares of their shape's area, so that a batch weighs its shapes alike and the
    loss does not depend on the number of faces.

    Args:
        shape: the source(s).
        prediction: what the network made of them; a pinned map, in any position.
        target: (…, n, c) Ψ, the images of the vertices, in any position.
        reduction: "mean" over the shapes, or "none" for the loss of each.
    """
    mesh = shape.mesh
    phi = prediction.vertices if shape.handles is None else centre_areas(shape, prediction.vertices)
    difference = phi - centre_areas(shape, target)
    vertices = shape.vertex_weights.to(difference.dtype) * difference.square().sum(-1)
    difference = prediction.jacobians - dp.jacobians(mesh, target)
    jacobians = shape.face_weights.to(difference.dtype) * difference.square().sum((-2, -1))
    return _sum(
        _reduced(vertices, mesh.part_of_vertex, mesh.n_parts, reduction),
        _reduced(jacobians, mesh.part_of_face, mesh.n_parts, reduction),
    )


def turned_loss(
    shape: Shape,
    prediction: Prediction,
    target: Float[Tensor, "*#batch n 2"],
    reduction: Reduction = "mean",
) -> Loss:
    """`paper_loss` after each target has been turned about its centre onto the map.

    For maps whose energy does not see rotations, as UV maps' does not: where a patch is bent so far
    that its projection says little, the target's rotation is arbitrary and can't be learned.

    Args:
        shape: the source(s).
        prediction: what the network made of them, maps to the plane.
        target: (…, n, 2) Ψ, the images of the vertices, in any position.
        reduction: "mean" over the shapes, or "none" for the loss of each.
    """
    with torch.no_grad():
        part, phi = shape.mesh.part_of_vertex, prediction.vertices
        weighted = shape.vertex_weights.to(phi.dtype)[:, None] * centre_areas(shape, target)
        covariance = phi[..., :, None] * weighted[..., None, :]
        sums = covariance.new_zeros(*covariance.shape[:-3], shape.mesh.n_parts, 2, 2)
        turns = dp.closest_rotation(sums.index_add(-3, part, covariance))
        turned = (turns[..., part, :, :] @ target[..., None].to(phi.dtype))[..., 0]
    return paper_loss(shape, prediction, turned, reduction)


def official_loss(
    shape: Shape, prediction: Prediction, target: Float[Tensor, "*#batch n c"]
) -> Loss:
    """The authors' experiments: mean squared errors over all entries, 10 vertices + Jacobians.

    Args:
        shape: the source(s).
        prediction: what the network made of them, of a model with `centering="vertex"`.
        target: (…, n, c) Ψ, the images of the vertices, in any position.
    """
    vertices = (prediction.vertices - centre_vertices(shape, target)).square().mean()
    jacobians = (prediction.jacobians - dp.jacobians(shape.mesh, target)).square().mean()
    return _sum(vertices, jacobians)


def sampled_loss(
    predicted: Float[Tensor, "b t k *c"], target: Float[Tensor, "b t k *c"]
) -> Float[Tensor, ""]:
    """Mean over cells drawn by area of ‖R - J‖² or ‖Φ - Ψ‖²: a term of `paper_loss` in expectation.

    Args:
        predicted: of each cell, for t maps of b shapes.
        target: what it should be.
    """
    return (predicted - target).square().flatten(3).sum(-1).mean()


def distortion_loss(
    shape: Shape, prediction: Prediction, epsilon: float = 0.1, reduction: Reduction = "mean"
) -> Float[Tensor, "*batch"]:
    """Mean over the area of log(E / 4), averaged over the shapes; near 0 at isometries.

    E is the symmetric Dirichlet energy of the emitted map, regularised so that flips are finite and
    unflipping them lowers it. Its logarithm keeps a few deep flips from drowning everything else.

    Args:
        shape: the source(s).
        prediction: maps to the plane.
        epsilon: of `diffpoisson.symmetric_dirichlet`.
        reduction: "mean" over the shapes, or "none" for the loss of each.
    """
    J = dp.jacobians(shape.mesh, prediction.vertices)
    density = (dp.symmetric_dirichlet(J, epsilon) / 4).log()
    weighted = shape.face_weights.to(density.dtype) * density
    return _reduced(weighted, shape.mesh.part_of_face, shape.mesh.n_parts, reduction)


def _reduced(
    values: Float[Tensor, "*batch n"], part: Int[Tensor, "n"], n_parts: int, reduction: Reduction
) -> Tensor:
    """The sum over each part, or its mean over parts and batch."""
    sums = values.new_zeros(*values.shape[:-1], n_parts).index_add(-1, part, values)
    return sums if reduction == "none" else sums.mean()


def _sum(vertices: Tensor, jacobians: Tensor) -> Loss:
    return Loss(VERTEX_WEIGHT * vertices + jacobians, vertices, jacobians)


LOSSES = {"paper": paper_loss, "turned": turned_loss, "official": official_loss}
PER_SHAPE = {"paper": paper_loss, "turned": turned_loss}  # those with a reduction
