"""The network's field, a prediction and a training step, against their plain formulation.

Plain is what the paper's formulas say when typed in: the code beside the features of every face, an
`nn.Sequential` with `nn.GroupNorm`, SciPy's SuperLU for the solve. Weights are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import scipy.sparse.linalg
import torch
from torch import Tensor, nn

import diffpoisson as dp
from diffpoisson import testing
from diffpoisson.gradient import gradient_operator, matrices_to_columns
from njf_models.features import Shape
from njf_models.field import FieldMLP
from njf_models.losses import paper_loss
from njf_models.njf import NeuralJacobianField, Prediction
from tests.benchmarks import limits
from tests.benchmarks.figures import Figure, Limit, Spread, Target, speed_up
from tests.benchmarks.harness import alternate, main
from tests.benchmarks.operators import csr

# ------------------------------------------------------- plain


class PlainSolve(torch.autograd.Function):
    """b ↦ L⁻¹ b by SuperLU; its derivative is itself."""

    @staticmethod
    def forward(ctx: Any, b: Tensor, lu: scipy.sparse.linalg.SuperLU) -> Tensor:
        ctx.lu = lu
        return torch.from_numpy(lu.solve(b.detach().numpy()))

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return PlainSolve.apply(grad.contiguous(), ctx.lu), None


class PlainNJF:
    """A `NeuralJacobianField` of a mesh's faces, as the formulas say."""

    def __init__(self, model: NeuralJacobianField, shape: Shape) -> None:
        self.encode, self.layers, self.shape = model.encode, model.field.layers, shape
        L = dp.laplacian(shape.mesh)[1:, 1:]
        self.lu = scipy.sparse.linalg.splu(L.tocsc())
        self.divergence = csr(gradient_operator(shape.mesh).divergence_matrix[1:])

    def __call__(self, codes: Tensor) -> Prediction:
        """One target after the other through the network, all through one solve."""
        features = self.shape.features
        inputs = (torch.cat([code.expand(len(features), -1), features], dim=1) for code in codes)
        P = torch.stack([self.layers(x) for x in inputs]).unflatten(-1, (3, 3)) + torch.eye(3)
        R = P @ self.shape.frames
        phi = PlainSolve.apply(self.divergence @ matrices_to_columns(R.double()), self.lu)
        phi = torch.cat([phi.new_zeros(1, phi.shape[1]), phi])
        phi = phi - self.shape.vertex_weights @ phi
        return Prediction(P, R, phi.unflatten(1, (-1, 3)).movedim(0, 1).float())


# ------------------------------------------------------- figures


def field(quick: bool) -> Iterator[Figure]:
    """The field's MLP on the faces of 20 packed patches."""
    m, parts, code_size = (400 if quick else 20_000), 20, 128
    features, codes = torch.randn(m, 6), torch.randn(parts, code_size)
    part_of_face = torch.arange(parts).repeat_interleave(m // parts)
    mlp = _trained(FieldMLP(code_size, 6))

    def ours() -> Tensor:
        return mlp(features, codes, part_of_face)

    def plain() -> Tensor:
        return mlp.layers(torch.cat([codes[part_of_face], features], dim=1))

    def in_bfloat16() -> Tensor:
        with torch.autocast("cpu", dtype=torch.bfloat16):
            return ours()

    torch.testing.assert_close(ours(), plain(), rtol=1e-3, atol=1e-4)

    def step(predict: Callable[[], Tensor]) -> None:
        mlp.zero_grad()
        predict().float().square().sum().backward()

    seconds = alternate(
        {
            "ours": lambda: step(ours),
            "ours, bfloat16": lambda: step(in_bfloat16),
            "nn.Sequential with nn.GroupNorm": lambda: step(plain),
        },
        turns=2 if quick else 9,
    )
    what, peer = f"field MLP, forward + backward, {m:,} faces", "nn.Sequential with nn.GroupNorm"
    for name, dtype, least in (
        ("ours", torch.float32, 3.0),
        ("ours, bfloat16", torch.bfloat16, 5.0),
    ):
        flops = 3 * 2 * m * (3 * 128**2 + (6 + 9) * 128)
        limit = Limit("operations of the layers", flops / limits.peak_flops(dtype))
        title = f"{what}, {str(dtype).removeprefix('torch.')}"
        yield speed_up(title, seconds, peer, least, ours=name, limit=limit)


def inference(quick: bool) -> Iterator[Figure]:
    """One map of a mesh from a code of 2000 numbers; factors are at hand."""
    model, shape = _model_and_shape(quick)
    plain = PlainNJF(model, shape)
    code = torch.randn(1, model.field.code_size)
    works: dict[str, Callable[[], object]] = {
        "ours": lambda: model(shape, code),
        "plain": lambda: plain(code),
    }
    with torch.no_grad():
        torch.testing.assert_close(
            model(shape, code).vertices, plain(code).vertices, rtol=1e-3, atol=1e-3
        )
        seconds = alternate(works, turns=2 if quick else 9)
        # Anew each time: what is left of the heap's free blocks differs.
        turns = [{n: limits.peak_memory(work) for n, work in works.items()} for _ in range(7)]
    what = f"NJF inference, {shape.mesh.n_faces:,} faces, code 2000, one mesh"
    flops = 2 * shape.mesh.n_faces * (3 * 128**2 + (6 + 9) * 128)
    limit = Limit("operations of the layers", flops / limits.peak_flops(torch.float32))
    yield speed_up(what, seconds, "plain", 6.0, limit=limit)
    memory = {name: np.array([turn[name] for turn in turns]) for name in works}
    yield Figure(
        f"{what}: peak memory",
        "plain",
        Spread.of(memory["ours"] / memory["plain"]),
        target=Target("≤", 0.2),
        details={f"MB, {n}": round(np.median(sizes) / 1e6, 1) for n, sizes in memory.items()},
    )


def training(quick: bool) -> Iterator[Figure]:
    """One step of Adam for 16 targets of one mesh: encoder, field, solve, loss, backward."""
    model, shape = _model_and_shape(quick)
    plain = PlainNJF(model, shape)
    targets, points = (2, 32) if quick else (16, 1024)
    clouds = torch.randn(targets + 1, points, 6)
    images = torch.randn(targets, shape.mesh.n_vertices, 3)
    optimizer = torch.optim.Adam(model.parameters(), lr=0.0)  # the weights stay

    def step(predict: Callable[[], Prediction]) -> None:
        optimizer.zero_grad()
        paper_loss(shape, predict(), images).total.backward()
        optimizer.step()

    sources = clouds[:1].expand(targets, -1, -1)  # one for each target, where ours takes one alone
    works = {
        "ours": lambda: step(lambda: model(shape, model.encode(clouds[:1], clouds[1:]))),
        "plain": lambda: step(lambda: plain(model.encode(sources, clouds[1:]))),
    }
    gradients = []
    for work in works.values():
        work()
        gradients.append(model.field.layers[3].weight.grad.clone())
    torch.testing.assert_close(*gradients, rtol=0.01, atol=0.01 * float(gradients[0].abs().max()))
    seconds = alternate(works, turns=2 if quick else 7)
    what = f"NJF training step, {shape.mesh.n_faces:,} faces, {targets} targets"
    per_face = 3 * 128**2 + (6 + 9) * 128
    encoder = 2 * targets * points * (6 * 128 + 128**2 + 128 * 256 + 256 * 1000)
    flops = 3 * 2 * (targets * shape.mesh.n_faces * per_face + encoder)
    limit = Limit("operations of the layers", flops / limits.peak_flops(torch.float32))
    yield speed_up(what, seconds, "plain", 4.0, limit=limit)


def _model_and_shape(quick: bool) -> tuple[NeuralJacobianField, Shape]:
    """The paper's network, with both codes of size 1000, and a torus of 13,800 faces."""
    torch.manual_seed(0)
    model = NeuralJacobianField(6, 6, encodes_target=True)
    _trained(model.field)
    vertices, faces = testing.torus(0, *((9, 6) if quick else (115, 60)))
    return model, Shape.prepare(dp.Mesh(vertices, faces))


def _trained(mlp: FieldMLP) -> FieldMLP:
    """A last layer that is not zero, as it is before training."""
    assert isinstance(mlp.layers[-1], nn.Linear)
    nn.init.normal_(mlp.layers[-1].weight, std=0.01)
    return mlp


MEASUREMENTS = {"field": field, "inference": inference, "training": training}

if __name__ == "__main__":
    main("network", MEASUREMENTS)
