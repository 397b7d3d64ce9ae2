"""Training of a `ModalNJF`: functions, then coefficients, in the functions' own terms.

In a basis that is orthonormal in it, the paper's loss of a map is a constant plus the squared
distance of its coefficients from the best ones. So that trained on coefficients alone, a network
sees thousands of maps in the time of one Poisson solve of many, and has the same loss.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

import diffpoisson as dp
from njf_models.features import Shape
from njf_models.handles import Handles
from njf_models.losses import VERTEX_WEIGHT
from njf_models.modal_njf import Basis, ModalNJF

SHARES = (0.2, 0.3, 0.5)  # of the time: functions, first guess, corrections, if there are any
_BATCH = 128
_NOISE = 1.5  # corrections learn from errors of up to so many times those of the first guess


@dataclass(frozen=True, eq=False)
class KnownMaps:
    """Maps to learn.

    Attributes:
        code: (k, z).
        positions: (k, n, c) images of the vertices, which meet the handles.
    """

    code: Float[Tensor, "k z"]
    positions: Float[Tensor, "k n c"]


def fit_modal(
    model: ModalNJF,
    shape: Shape,
    train: KnownMaps,
    validation: KnownMaps,
    *,
    minutes: float,
    learning_rate: float = 2e-3,
    progress: Callable[[str], None] = print,
) -> float:
    """Train a model, in place.

    Corrections learn from coefficients that are off by random amounts, distributed as the first
    guess of the validation maps is off: it is better on maps that it has learned.

    Args:
        model: a new one.
        shape: with handles.
        train: what it learns from.
        validation: how far the first guess is off where it has not learned.
        minutes: of CPU time.
        learning_rate: of Adam, at the start of each part; it falls along a cosine.
        progress: told the error of each part.

    Returns:
        Seconds of CPU time that it took.
    """
    handles, start = shape.handles, time.process_time()
    if handles is None:
        raise ValueError("fit_modal: this needs a shape with handles")
    shares = np.array(SHARES if model.rounds > 1 else SHARES[:2])
    seconds = 60 * minutes * shares / shares.sum()
    weights = _Weights.of(shape)
    missing = _missing(handles, train)
    _fit_functions(model, shape, _principal(weights, shape, missing, model.rank), seconds[0])
    basis = _orthonormal(model, shape, weights, missing)
    best, held_out = (
        _best(basis, weights, shape, x) for x in (missing, _missing(handles, validation))
    )
    model.mean.copy_(best.mean(0))
    model.scale.copy_(best.std(0))

    def first_error(at: Tensor) -> Tensor:
        return (model.first_guess(train.code[at]) - best[at]).square().sum(-1).mean()

    until = start + seconds[0] + seconds[1]
    _descend(model.first, len(best), first_error, until, learning_rate)
    with torch.no_grad():
        misses = model.first_guess(validation.code) - held_out
        progress(f"first guess: squared error {misses.square().sum(-1).mean():.3g}")
        if model.rounds > 1:
            amounts = handles.amounts(train.code)
            read = torch.cat(
                [
                    model.reading(basis, a, h)
                    for a, h in zip(amounts.split(_BATCH), best.split(_BATCH), strict=True)
                ]
            )
            model.reading_mean.copy_(read.mean(0))
            model.reading_scale.copy_(read.std(0))
            model.step_scale.copy_(misses.std(0))
    if model.rounds > 1:
        spread = misses.T @ misses / len(misses)
        noise = _root(spread)

        def corrected_error(at: Tensor) -> Tensor:
            share = _NOISE * torch.rand(len(at), 1)
            h = best[at] + share * torch.randn(len(at), model.rank) @ noise
            with torch.no_grad():
                reading = model.reading(basis, amounts[at], h)
            return (model.corrected(train.code[at], h, reading) - best[at]).square().sum(-1).mean()

        networks = nn.ModuleList([model.correction, model.step])
        _descend(networks, len(best), corrected_error, start + seconds.sum(), learning_rate)
        with torch.no_grad():
            rounds = model.coefficients(shape, basis, validation.code)
        errors = ", ".join(f"{(h - held_out).square().sum(-1).mean():.3g}" for h in rounds)
        progress(f"rounds: squared errors {errors}")
    model.eval()
    return time.process_time() - start


def modal_in(
    folder: Path,
    arguments: dict[str, Any],
    shape: Shape,
    train: KnownMaps,
    validation: KnownMaps,
    *,
    minutes: float,
    seed: int,
) -> tuple[ModalNJF, dict[str, float]]:
    """The model that a folder keeps, trained now if it keeps none; and what its training took.

    Args:
        folder: for `model.pt`.
        arguments: of `ModalNJF`.
        shape: with handles.
        train: as of `fit_modal`, like the rest.
        validation: the same.
        minutes: of CPU time.
        seed: of weights and batches.
    """
    path = folder / "model.pt"
    if not path.exists():
        torch.manual_seed(seed)
        model = ModalNJF(**arguments)
        start = time.perf_counter()
        seconds = fit_modal(model, shape, train, validation, minutes=minutes)
        cost = {"cpu seconds": seconds, "seconds": time.perf_counter() - start}
        folder.mkdir(parents=True, exist_ok=True)
        torch.save({"arguments": arguments, "state": model.state_dict(), "cost": cost}, path)
    return load_modal(path)


def load_modal(path: Path) -> tuple[ModalNJF, dict[str, float]]:
    """A model that `modal_in` kept, and what its training took."""
    kept = torch.load(path, weights_only=True)
    model = ModalNJF(**kept["arguments"])
    model.load_state_dict(kept["state"])
    return model.eval(), kept["cost"]


def _descend(
    network: nn.Module, n: int, loss: Callable[[Tensor], Tensor], until: float, rate: float
) -> None:
    """Adam on random batches, until a time of the processor."""
    optimizer = torch.optim.Adam(network.parameters(), lr=rate)
    start = time.process_time()
    while (done := (time.process_time() - start) / (until - start)) < 1:
        optimizer.param_groups[0]["lr"] = rate * (1 + np.cos(np.pi * done)) / 2
        optimizer.zero_grad()
        loss(torch.randint(n, (_BATCH,))).backward()
        optimizer.step()


# -------------------------------------------------------------------- the loss as a norm


@dataclass(frozen=True, eq=False)
class _Weights:
    """Square roots of the weights of the paper's loss."""

    vertices: Float[Tensor, "n 1"]
    faces: Float[Tensor, "m 1 1"]

    @classmethod
    def of(cls, shape: Shape) -> _Weights:
        vertices = (VERTEX_WEIGHT * shape.vertex_weights).sqrt().float()
        return cls(vertices[:, None], shape.face_weights.sqrt().float()[:, None, None])

    def rows(
        self, maps: Float[Tensor, "k n c"], J: Float[Tensor, "k m c 2"]
    ) -> Float[Tensor, "k e"]:
        """Vectors whose squared lengths are the loss of maps and Jacobians against nought."""
        parts = (self.vertices * maps, self.faces * J)
        return torch.cat([part.flatten(1) for part in parts], dim=1)


def _missing(handles: Handles, maps: KnownMaps) -> Float[Tensor, "k n c"]:
    """What the harmonic maps miss."""
    amounts = handles.amounts(maps.code).double()
    harmonic = handles.rest + torch.einsum("tk,knc->tnc", amounts, handles.harmonic)
    return maps.positions - harmonic.to(maps.positions.dtype)


def _principal(
    weights: _Weights, shape: Shape, missing: Float[Tensor, "k n c"], rank: int
) -> Float[Tensor, "r m c 2"]:
    """Jacobians of the principal components of maps, by the loss, the last a tenth as large."""
    rows = weights.rows(missing, dp.jacobians(shape.mesh, missing))
    rank = min(rank, *rows.shape)
    _, sizes, V = torch.svd_lowrank(rows - rows.mean(0), rank)
    n = missing[0].numel()
    J = V[n:].T.unflatten(-1, (shape.mesh.n_faces, missing.shape[-1], 2)) / weights.faces
    return (sizes / sizes[0]).sqrt()[:, None, None, None] * J


def _fit_functions(
    model: ModalNJF, shape: Shape, goal: Float[Tensor, "r m c 2"], seconds: float
) -> None:
    """Teach T the given fields; at last its last layer by least squares."""
    start, inputs = time.process_time(), model.face_inputs(shape)
    target = dp.extend(goal, shape.frames).transpose(0, 1).flatten(1)  # (m, r · c · 3)
    count = target.shape[1]
    *hidden, last = model.of_face
    assert isinstance(last, nn.Linear)

    def error(at: Tensor) -> Tensor:
        return (model.of_face(inputs[at])[:, :count] - target[at]).square().sum(-1).mean()

    _descend(model.of_face, len(inputs), error, start + 0.95 * seconds, 3e-3)
    with torch.no_grad():
        x = nn.Sequential(*hidden)(inputs)
        x = (
            torch.cat([x, x.new_ones(len(x), 1)], dim=1)
            * shape.face_weights.sqrt().float()[:, None]
        )
        y = target * shape.face_weights.sqrt().float()[:, None]
        solution = torch.linalg.lstsq(x, y, driver="gelsd").solution
        last.weight[:count], last.bias[:count] = solution[:-1].T, solution[-1]


@torch.no_grad()
def _orthonormal(
    model: ModalNJF, shape: Shape, weights: _Weights, missing: Float[Tensor, "k n c"]
) -> Basis:
    """Change T so that its functions are orthonormal by the loss, the most needed ones first."""
    basis = model.basis(shape)
    rows = weights.rows(basis.maps, basis.fields).double()
    eigenvalues, vectors = torch.linalg.eigh(rows @ rows.T)
    # Functions are rounded to single precision, so their products are known to 2 ε of their trace.
    # Below that a combination of them is nothing but rounding: not to be blown up to length one.
    known = 2 * torch.finfo(torch.float32).eps * eigenvalues.sum()
    change = vectors.T / eigenvalues.clamp_min(known).sqrt()[:, None]
    best = _best(basis, weights, shape, missing, change)
    *_, V = torch.linalg.svd(best - best.mean(0), full_matrices=False)
    change = V @ change
    last = model.of_face[-1]
    assert isinstance(last, nn.Linear)
    for parameter in (last.weight, last.bias):
        functions = parameter.unflatten(0, (model.rank, -1))
        changed = torch.einsum("rq,q...->r...", change.float(), functions)
        parameter.copy_(changed.flatten(0, 1))
    return model.basis(shape)


@torch.no_grad()
def _best(
    basis: Basis,
    weights: _Weights,
    shape: Shape,
    missing: Float[Tensor, "k n c"],
    change: Float[Tensor, "r r"] | None = None,
) -> Float[Tensor, "k r"]:
    """Coefficients of least loss, in a basis that is orthonormal, by a change of it if given."""
    rows = weights.rows(basis.maps, basis.fields).double()
    rows = rows if change is None else change @ rows
    products = weights.rows(missing, dp.jacobians(shape.mesh, missing)).double() @ rows.T
    return products if change is not None else products.float()


def _root(spread: Float[Tensor, "r r"]) -> Float[Tensor, "r r"]:
    """A square root of a semidefinite matrix."""
    eigenvalues, vectors = torch.linalg.eigh(spread.double())
    return (eigenvalues.clamp_min(0).sqrt()[:, None] * vectors.T).float()
