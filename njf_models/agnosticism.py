"""Does a map depend on the triangulation? The same bodies, mapped on several, compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

import diffpoisson as dp
from njf_models.body_maps import BodyMaps
from njf_models.datasets.bodies import Body, BodyModel, retriangulated
from njf_models.datasets.triangulation import Triangulation
from njf_models.models import Model
from njf_models.trained import Inputs
from njf_models.training import encoded


@dataclass(frozen=True)
class Deviation:
    """Maps on one triangulation, beside those on the triangulation that was trained on.

    Attributes:
        n_faces: of the triangulation.
        error: mean distance of the map to the target, in metres.
        deviation: mean distance of corresponding points of the two maps, in metres.
        share: deviation over the error on the triangulation that was trained on.
        exact: what the deviation would be of exact maps, in metres. It is not zero where the other
            triangulation is too coarse: between its vertices, it is off the surface.
    """

    n_faces: int
    error: float
    deviation: float
    share: float
    exact: float


@torch.no_grad()
def compare_triangulations(
    model: Model,
    inputs: Inputs,
    *,
    body_model: BodyModel,
    trained_on: Triangulation,
    others: dict[str, Triangulation],
    bodies: Sequence[Body],
) -> dict[str, Deviation]:
    """Maps of bodies to their poses on each triangulation, compared with those on the first.

    Everything that the network sees is computed on the triangulation itself: features, points for
    the encoder, wave-kernel signature. Maps are compared at the vertices of `trained_on`, which are
    points of the reference: on another triangulation, at the points closest to these. Means weigh
    these points alike, and each map is centred there.

    Args:
        model: a trained model.
        inputs: what it sees.
        body_model: for the bodies on other triangulations.
        trained_on: what the bodies are given on.
        others: triangulations by name.
        bodies: on `trained_on`.
    """
    own = [_map(model, body, inputs) for body in bodies]
    targets = [body.posed.double() for body in bodies]
    own_error = _distance(own, targets)
    deviations = {}
    for name, other in others.items():
        at = _counterparts(body_model.reference, trained_on, other)
        elsewhere = [retriangulated(body_model, other, body) for body in bodies]
        there = [at.deformed(_map(model, body, inputs)) for body in elsewhere]
        exact = _distance([at.deformed(body.posed.double()) for body in elsewhere], targets)
        apart, error = _distance(own, there), _distance(there, targets)
        deviations[name] = Deviation(len(other.faces), error, apart, apart / own_error, exact)
    return deviations


def _map(model: Model, body: Body, inputs: Inputs) -> Float[Tensor, "t n 3"]:
    """The map of a body to each of its poses."""
    maps = BodyMaps(
        [body],
        n_targets=len(body.poses),
        n_points=inputs.n_points,
        n_energies=inputs.n_energies,
        n_basis=inputs.n_basis,
        basis_at=inputs.basis_at,
    )
    batch = maps[0]
    return model(batch.shape, encoded(model, batch)).vertices.double()


def _counterparts(reference: dp.Mesh, points: Triangulation, of: Triangulation) -> Triangulation:
    """The vertices of one triangulation embedded in another, both at rest."""
    x = reference.vertices
    mesh = dp.Mesh(of.deformed(x), of.faces)
    return Triangulation.embedded(mesh, points.deformed(x), points.faces)


def _distance(some: Sequence[Tensor], others: Sequence[Tensor]) -> float:
    """Mean distance of points over all maps, each centred."""
    distances = []
    for a, b in zip(some, others, strict=True):
        apart = a - b
        apart = apart - apart.mean(dim=-2, keepdim=True)
        distances.append(torch.linalg.vector_norm(apart, dim=-1).mean(-1))
    return float(torch.cat(distances).mean())
