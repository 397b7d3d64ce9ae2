"""UV training in packed batches, against one patch a step through `nn.GroupNorm`.

Losses are those of `njf train` by default; patches are of generated parts.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from njf_models.datasets.fingerprint import fingerprint
from njf_models.datasets.patches import PatchOptions, PatchSampler
from njf_models.datasets.sources import CSGParts
from njf_models.datasets.uv import FlatPatch, UVPatch, draw
from njf_models.features import Motions
from njf_models.field import FieldMLP
from njf_models.njf import NeuralJacobianField
from njf_models.training import Batch, Objective, UVExamples
from tests.benchmarks.figures import Figure, Spread, Target, speed_up
from tests.benchmarks.harness import alternate, main

ARGUMENTS = {"face_features": 6, "point_features": 6, "code_size": 256, "output_dim": 2}
NARROW = {"rounds": 4, "width": 32, "local_step": True}  # as the shipped weights
NETWORKS = {"`njf train`'s default": {"rounds": 2}, "4 rounds, 32 wide": NARROW}
OBJECTIVE = Objective(distortion=0.3, augment=True)
PACKED = (8, 16)
BUDGET = 60.0  # processor seconds of training, where losses are compared


class PlainMLP(FieldMLP):
    """The field as a plain `nn.Sequential` of [code | features], for one patch."""

    def forward(self, features: Tensor, code: Tensor, part_of_face: Tensor | None = None) -> Tensor:
        assert part_of_face is None
        features = features.expand(*code.shape[:-1], *features.shape[-2:])
        codes = code[..., None, :].expand(*features.shape[:-1], -1)
        x = torch.cat([codes, features], dim=-1)
        return self.layers(x.flatten(0, -2)).unflatten(0, x.shape[:-1])


class HalfMLP(FieldMLP):
    """The field's layers in bfloat16; what is solved and differentiated stays in float32."""

    def forward(self, *args: Tensor | None) -> Tensor:
        with torch.autocast("cpu", dtype=torch.bfloat16):
            return super().forward(*args).float()


class Training:
    """A network in training: one step after the other, through the examples in turn."""

    def __init__(
        self,
        examples: UVExamples,
        network: Mapping[str, Any],
        *,
        packed: int = 1,
        kind: type[FieldMLP] = FieldMLP,
    ) -> None:
        torch.manual_seed(0)
        self.examples, self.packed = examples, packed
        self.model = NeuralJacobianField(**ARGUMENTS, **network)
        for mlp in (self.model.field, *self.model.corrections):
            mlp.__class__ = kind
        self.optimizer = torch.optim.Adam(self.model.parameters(), lr=1e-3)
        self.seen = 0

    def step(self) -> None:
        chosen = [(self.seen + i) % len(self.examples) for i in range(self.packed)]
        batch = Batch.pack([self.examples[i] for i in chosen]).moved(Motions.random(self.packed))
        self.seen += self.packed
        self.optimizer.zero_grad()
        self._loss(batch, every_round=True).backward()
        self.optimizer.step()

    def validated(self, examples: UVExamples) -> float:
        """Mean loss of the last round."""
        with torch.no_grad():
            losses = [self._loss(Batch.pack([e]), every_round=False).item() for e in examples]
        return float(np.mean(losses))

    def _loss(self, batch: Batch, *, every_round: bool) -> Tensor:
        predictions = self.model.iterates(batch.shape, self.model.encode(batch.points))
        chosen = predictions if every_round else predictions[-1:]
        return torch.stack([OBJECTIVE(batch, prediction).total for prediction in chosen]).mean()


def throughput(quick: bool) -> Iterator[Figure]:
    """Patches per second of a whole step: points, packing, network, solves, loss, Adam."""
    train, _ = examples(quick)
    for _ in train:  # every example is prepared once, and kept
        pass
    for name, network in NETWORKS.items():
        for packed in PACKED:
            yield from _throughput(train, name, network, packed, turns=2 if quick else 9)


def _throughput(
    train: UVExamples, name: str, network: Mapping[str, Any], packed: int, turns: int
) -> Iterator[Figure]:
    single = Training(train, network, kind=PlainMLP)

    def one_by_one() -> None:
        for _ in range(packed):
            single.step()

    contestants = {
        "ours": Training(train, network, packed=packed).step,
        "ours, bfloat16": Training(train, network, packed=packed, kind=HalfMLP).step,
        "one patch a step": one_by_one,
    }
    seconds = alternate(contestants, turns)
    faces = float(np.mean([len(patch.faces) for patch in train.patches]))
    what = f"UV training, patches of {faces:,.0f} faces, {name}, {packed} packed"
    yield speed_up(what, seconds, "one patch a step", 3.0)
    ours = "ours, bfloat16"
    yield speed_up(f"{what}, bfloat16", seconds, "one patch a step", ours=ours)


def accuracy(quick: bool) -> Iterator[Figure]:
    """Losses on other meshes after equal time, and of bfloat16 after equal steps.

    The median and quartiles are those of five validations in the last half of the time.
    """
    train, validation = examples(quick)
    budget = 0.3 if quick else BUDGET
    marks = np.linspace(0.6, 1.0, 5) * budget
    packed = PACKED[-1]
    steps, ours = _losses(Training(train, NARROW, packed=packed), validation, marks)
    _, theirs = _losses(Training(train, NARROW, kind=PlainMLP), validation, marks)
    half = Training(train, NARROW, packed=packed, kind=HalfMLP)
    rounded = _losses_after(half, validation, steps)
    what = f"validation loss after {budget:.0f} s of training, 4 rounds, 32 wide, {packed} packed"
    yield _losses_ratio(what, "one patch a step", ours, theirs)
    what = f"validation loss in bfloat16 after {steps[-1]} steps of that"
    yield _losses_ratio(what, "float32", rounded, ours)


def _losses(
    training: Training, validation: UVExamples, marks: np.ndarray
) -> tuple[list[int], list[float]]:
    """Steps made, and losses, at some processor times of training."""
    spent, steps, counts, losses = 0.0, 0, [], []
    for mark in marks:
        while spent < mark:
            start = time.process_time()
            training.step()
            spent += time.process_time() - start
            steps += 1
        counts.append(steps)
        losses.append(training.validated(validation))
    return counts, losses


def _losses_after(training: Training, validation: UVExamples, counts: list[int]) -> list[float]:
    """Losses after some numbers of steps."""
    losses = []
    for steps in np.diff([0, *counts]):
        for _ in range(steps):
            training.step()
        losses.append(training.validated(validation))
    return losses


def _losses_ratio(what: str, against: str, ours: list[float], theirs: list[float]) -> Figure:
    value = Spread.of(np.array(ours) / np.array(theirs))
    losses = {"ours": ours, against: theirs}
    return Figure(what, against, value, target=Target("≤", 1.0), details={"losses": losses})


def examples(quick: bool) -> tuple[UVExamples, UVExamples]:
    """Patches of about 1,000 faces of generated parts, and of other parts to validate on."""
    faces, parts, per_part = ((100, 150), 2, 2) if quick else ((800, 1200), 12, 8)
    patches = generated_patches(faces, parts, per_part)
    held = {patch.family for patch in patches[: len(patches) // 4]}
    kind = {"n_points": 256, "use_wks": False}
    train = [patch for patch in patches if patch.family not in held]
    validation = [patch for patch in patches if patch.family in held]
    return UVExamples(train, resample=True, **kind), UVExamples(validation, **kind)


def generated_patches(faces: tuple[int, int], parts: int, per_part: int) -> list[UVPatch]:
    """Training pairs of patches of so many faces, so many of each of some generated parts."""
    patches = []
    for raw in CSGParts(parts, n_faces=5 * faces[1]):
        sampler = PatchSampler(raw.vertices, raw.faces, PatchOptions(*faces))
        for i in range(per_part):
            flat, _ = draw(sampler, fingerprint(raw.name), 0, i, 0)
            if flat is not None:
                patches.append(_pair(flat, raw.name))
    return patches


def _pair(flat: FlatPatch, name: str) -> UVPatch:
    mesh, about = flat.patch.mesh, (name, name, flat.patch.flatness, flat.energy)
    return UVPatch(mesh.vertices, mesh.faces, flat.uv.double(), flat.wks.float(), *about)


MEASUREMENTS: dict[str, Callable[[bool], Iterator[Figure]]] = {
    "throughput": throughput,
    "accuracy": accuracy,
}

if __name__ == "__main__":
    main("uv_training", MEASUREMENTS)
