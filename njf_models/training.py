"""Training a Neural Jacobian Field with Lightning: batches, the training module, the trainer."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any, NamedTuple

import lightning
import torch
from jaxtyping import Float
from lightning.pytorch.callbacks import (
    Callback,
    EarlyStopping,
    LearningRateMonitor,
    ModelCheckpoint,
    TQDMProgressBar,
)
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

import diffpoisson as dp
from njf_models.datasets.uv import UVPatch
from njf_models.features import Motions, Shape, point_features
from njf_models.losses import LOSSES, PER_SHAPE, Loss, distortion_loss, sampled_loss
from njf_models.metrics import count_flips
from njf_models.models import MODELS, Model
from njf_models.njf import Prediction
from njf_models.sampled import Cells


@dataclass(frozen=True)
class Example:
    """One source shape and its target map.

    Attributes:
        shape: the prepared source.
        points: (s, f) point features of the source, for the encoder.
        target: (n, c) target image of each vertex.
    """

    shape: Shape
    points: Float[Tensor, "s f"]
    target: Float[Tensor, "n c"]


@dataclass(frozen=True)
class Batch:
    """Maps to learn in one step: of several shapes packed into one, or many of one shape.

    Attributes:
        shape: the union of the sources, or the one source.
        points: (sources, s, f) point features of each source; None for models without an encoder.
        target: (n, c) target images of all vertices, or (t, n, c) of the one source.
        parameters: (t, p) parameters of each of its targets.
        target_points: (t, s, f) point features of each of them, if the code is made from them.
    """

    shape: Shape
    points: Float[Tensor, "sources s f"] | None
    target: Float[Tensor, "*t n c"]
    parameters: Float[Tensor, "*t p"] | None = None
    target_points: Float[Tensor, "*t s f"] | None = None

    @property
    def n_maps(self) -> int:
        """Number of maps."""
        return self.shape.mesh.n_parts if self.target.ndim == 2 else len(self.target)

    @classmethod
    def pack(cls, examples: Sequence[Example]) -> Batch:
        """Concatenate the shapes, so that one pass of the network serves all their faces."""
        return cls(
            Shape.concatenate([example.shape for example in examples]),
            torch.stack([example.points for example in examples]),
            torch.cat([example.target for example in examples]),
        )

    def moved(self, motions: Motions) -> Batch:
        """Each part and its target as the network would see them turned and scaled.

        The loss of the moved batch is that of an equally good map of the unmoved one: targets keep
        their scale, since Jacobians have none.
        """
        images = motions.images.to(self.target.dtype)[self.shape.mesh.part_of_vertex]
        target = (images @ self.target[..., None])[..., 0]
        points = None if self.points is None else motions.points(self.points)
        return Batch(self.shape.moved(motions), points, target)


class UVExamples(Dataset[Example]):
    """UV patches as training examples, each prepared at its first use and kept.

    Args:
        patches: the training pairs.
        n_points: how many points the encoder sees.
        resample: draw new points at each access (training) or always the same (evaluation).
        use_wks: whether the network sees the wave-kernel signature.
        n_eigenpairs: of the spectrum, for models that diffuse.
    """

    def __init__(
        self,
        patches: Sequence[UVPatch],
        *,
        n_points: int = 1024,
        resample: bool = False,
        use_wks: bool = True,
        n_eigenpairs: int = 0,
    ) -> None:
        self.patches = patches
        self.n_points, self.resample, self.use_wks = n_points, resample, use_wks
        self.n_eigenpairs = n_eigenpairs
        self._kept: dict[int, tuple[UVPatch, Shape]] = {}

    def __len__(self) -> int:
        return len(self.patches)

    def patch(self, index: int) -> UVPatch:
        """The patch of an example."""
        return self._prepared(index)[0]

    def __getitem__(self, index: int) -> Example:
        patch, shape = self._prepared(index)
        generator = None if self.resample else torch.Generator().manual_seed(index)
        samples = dp.sample_surface(patch.mesh, self.n_points, generator=generator)
        points = point_features(patch.mesh, samples, patch.wks if self.use_wks else None)
        return Example(shape, points.float(), patch.uv.float())

    def _prepared(self, index: int) -> tuple[UVPatch, Shape]:
        if index not in self._kept:
            patch = self.patches[index]
            wks = patch.wks if self.use_wks else None
            shape = Shape.prepare(patch.mesh, wks, n_eigenpairs=self.n_eigenpairs)
            self._kept[index] = patch, shape
        return self._kept[index]


@dataclass(frozen=True)
class Objective:
    """What training minimises: supervised loss + distortion · distortion loss.

    Attributes:
        supervised: one of `losses.LOSSES`, or None for training without targets.
        distortion: weight of `losses.distortion_loss`, for maps to the plane.
        epsilon: its regularisation.
        augment: whether each batch is turned, mirrored and scaled at random.
        robust: whether a shape counts by log(1 + its supervised loss): a hard one, which pulls
            a thousand times as hard as a good one, then pulls about as hard.
    """

    supervised: str | None = "paper"
    distortion: float = 0.0
    epsilon: float = 0.1
    augment: bool = False
    robust: bool = False

    def __post_init__(self) -> None:
        if self.supervised is not None and self.supervised not in LOSSES:
            raise ValueError(
                f"Objective: supervised must be None or one of {sorted(LOSSES)}, "
                f"got {self.supervised!r}"
            )
        if self.supervised is None and not self.distortion > 0:
            raise ValueError("Objective: without targets, distortion must have a positive weight")
        if self.robust and self.supervised not in PER_SHAPE:
            raise ValueError(
                f"Objective: robust needs a supervised loss of each shape, one of "
                f"{sorted(PER_SHAPE)}, got {self.supervised!r}"
            )

    def __call__(self, batch: Batch, prediction: Prediction) -> Loss:
        """Loss of one round, and its terms."""
        zero = prediction.vertices.new_zeros(())
        loss = Loss(zero, zero, zero)
        if self.robust and self.supervised is not None:
            each = PER_SHAPE[self.supervised](batch.shape, prediction, batch.target, "none")
            loss = Loss(each.total.log1p().mean(), each.vertices.mean(), each.jacobians.mean())
        elif self.supervised is not None:
            loss = LOSSES[self.supervised](batch.shape, prediction, batch.target)
        if self.distortion:
            distortion = distortion_loss(batch.shape, prediction, self.epsilon)
            loss = loss._replace(total=loss.total + self.distortion * distortion)
        return loss


@dataclass
class _Stopwatch:
    """Seconds of a clock over several runs.

    Attributes:
        clock: what tells the time.
        earlier: seconds of earlier runs; None if they are not known.
        started: when the present run started, if one is going on.
    """

    clock: Callable[[], float]
    earlier: float | None = 0.0
    started: float | None = None

    @property
    def seconds(self) -> float | None:
        if self.earlier is None or self.started is None:
            return self.earlier
        return self.earlier + self.clock() - self.started

    def start(self) -> None:
        self.started = self.clock()

    def stop(self) -> None:
        self.earlier, self.started = self.seconds, None


def rate_share(step: int, steps: int, warmup: int) -> float:
    """Share of the learning rate at a step: it rises along a line, and falls along a cosine."""
    rise = min(1.0, (step + 1) / warmup) if warmup else 1.0
    return rise * (1 + math.cos(math.pi * step / steps)) / 2


class TimedModule(lightning.LightningModule):
    """A training that knows how long it has taken.

    Checkpoints record `training_seconds` and `cpu_seconds`, over all runs, validations included;
    None where an earlier run did not record its own.
    """

    def __init__(self) -> None:
        super().__init__()
        self._wall, self._cpu = _Stopwatch(time.perf_counter), _Stopwatch(time.process_time)

    @property
    def training_seconds(self) -> float | None:
        """Wall time of training until now, over all runs; None if some did not record theirs."""
        return self._wall.seconds

    @property
    def cpu_seconds(self) -> float | None:
        """The same of this process's CPU time, which does not depend on what else runs."""
        return self._cpu.seconds

    def on_train_start(self) -> None:
        """The clocks start."""
        self._wall.start()
        self._cpu.start()

    def on_train_end(self) -> None:
        """The clocks stop."""
        self._wall.stop()
        self._cpu.stop()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Record the times."""
        checkpoint |= {"training_seconds": self._wall.seconds, "cpu_seconds": self._cpu.seconds}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Go on counting."""
        self._wall.earlier = checkpoint.get("training_seconds")
        self._cpu.earlier = checkpoint.get("cpu_seconds")


class NJFTraining(TimedModule):
    """Training with Adam, by the paper's schedule or by a cosine.

    Args:
        model: arguments of the model, kept in the checkpoint.
        objective: arguments of `Objective`.
        learning_rate: of Adam, at the start.
        patience: validations without improvement before the rate falls to a tenth (the paper).
        steps: let the rate fall to zero along a cosine over so many steps instead.
        warmup: and rise to it in so many.
        inputs: fields of `trained.Inputs`, what the network sees, for the record.
        kind: one of `models.MODELS`: Neural Jacobian Fields, or a baseline.
    """

    def __init__(
        self,
        model: dict[str, Any],
        objective: dict[str, Any] | None = None,
        *,
        learning_rate: float = 1e-3,
        patience: int = 10,
        steps: int | None = None,
        warmup: int = 0,
        inputs: dict[str, Any] | None = None,
        kind: str = "njf",
    ) -> None:
        super().__init__()
        self.objective = Objective(**(objective or {}))
        self.save_hyperparameters()
        if kind not in MODELS:
            raise ValueError(f"NJFTraining: kind must be one of {sorted(MODELS)}, got {kind!r}")
        self.model = MODELS[kind](**model)
        if self.objective.augment and self.model.output_dim != 2:
            raise ValueError("NJFTraining: augment turns planar maps; set output_dim=2 or leave it")
        self.learning_rate, self.patience = learning_rate, patience
        self.steps, self.warmup = steps, warmup

    def training_step(self, batch: Batch | Cells, batch_idx: int) -> Tensor:
        """Loss of one packed batch, averaged over the rounds; or of samples of several shapes."""
        if isinstance(batch, Cells):
            return self._sampled_step(batch)
        size = batch.n_maps
        if self.objective.augment:
            batch = batch.moved(Motions.random(size))
        losses = [self.objective(batch, prediction).total for prediction in self._iterates(batch)]
        loss = torch.stack(losses).mean()
        self.log("train/loss", loss, prog_bar=True, on_step=False, on_epoch=True, batch_size=size)
        return loss

    def _sampled_step(self, cells: Cells) -> Tensor:
        if self.objective != Objective():
            raise ValueError(
                f"NJFTraining: samples are trained by the paper's loss alone, not {self.objective}"
            )
        # One cloud for all targets of a shape.
        points = cells.points[:, None]
        code = self.model.encode(points, cells.target_points, cells.parameters)
        loss = sampled_loss(self.model.at(cells, code), cells.target)
        size = code.shape[:2].numel()
        self.log(
            "train/sampled", loss, prog_bar=True, on_step=False, on_epoch=True, batch_size=size
        )
        return loss

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Losses and flips per shape of one packed batch, after the last round."""
        prediction = self._iterates(batch)[-1]
        loss = self.objective(batch, prediction)
        size = batch.n_maps
        values = {f"validation/{name}": value for name, value in loss._asdict().items()}
        if self.model.output_dim == 2:
            J = dp.jacobians(batch.shape.mesh, prediction.vertices)
            values["validation/flips"] = count_flips(J).sum().float() / size
        self.log("validation/loss", loss.total, prog_bar=True, batch_size=size, sync_dist=True)
        self.log_dict(values, batch_size=size, sync_dist=True)

    def _iterates(self, batch: Batch) -> list[Prediction]:
        return self.model.iterates(batch.shape, encoded(self.model, batch))

    def configure_optimizers(self) -> Any:
        """Adam and the schedule of its rate."""
        optimizer = torch.optim.Adam(self.parameters(), lr=self.learning_rate)
        if self.steps is not None:
            steps, warmup = self.steps, self.warmup
            schedule = torch.optim.lr_scheduler.LambdaLR(
                optimizer, lambda step: rate_share(step, steps, warmup)
            )
            scheduler = {"scheduler": schedule, "interval": "step"}
        else:
            plateau = torch.optim.lr_scheduler.ReduceLROnPlateau(
                optimizer, factor=0.1, patience=self.patience, min_lr=self.learning_rate / 10
            )
            scheduler = {"scheduler": plateau, "monitor": "validation/loss"}
        return {"optimizer": optimizer, "lr_scheduler": scheduler}

    def transfer_batch_to_device(
        self, batch: Batch | Cells, device: torch.device, dataloader_idx: int
    ) -> Batch | Cells:
        """The batch as it is: it lives where its factors do."""
        return batch


def encoded(model: Model, batch: Batch) -> Float[Tensor, "*t z"]:
    """The codes of a batch's maps."""
    return model.encode(batch.points, batch.target_points, batch.parameters)


def loader(examples: UVExamples, batch_size: int, *, shuffle: bool = False) -> DataLoader[Example]:
    """Packed batches. Factors live in this process, so there are no workers."""
    return DataLoader(examples, batch_size=batch_size, shuffle=shuffle, collate_fn=Batch.pack)


def make_trainer(
    folder: Path,
    *,
    minutes: float | None = None,
    steps: int | None = None,
    stop_after: int | None = None,
    validate_every: int | None = None,
    processes: int = 1,
) -> lightning.Trainer:
    """A trainer that shows progress, logs to CSV and TensorBoard, and can be stopped and resumed.

    Pass `ckpt_path=last_checkpoint(folder)` to `fit` to go on where an earlier run ended, also one
    that was interrupted.

    Args:
        folder: where logs and checkpoints go.
        minutes: stop after this time; None for no limit.
        steps: stop after so many steps; None for no limit.
        stop_after: stop after this many validations without improvement; None for no such limit.
        validate_every: validate after so many steps, not after each pass over the data.
        processes: train data-parallel in so many processes on this machine.
    """
    where: dict[str, Any] = {"dirpath": folder / "checkpoints", "enable_version_counter": False}
    best = ModelCheckpoint(filename="best", monitor="validation/loss", **where)
    # Lightning's own save_last saves only where the monitored value got better.
    last = ModelCheckpoint(filename="last", save_on_exception=True, **where)
    ending = _SaveAtTheEnd(where["dirpath"] / "last.ckpt")
    rate = LearningRateMonitor(logging_interval="epoch")
    callbacks: list[Callback] = [best, last, ending, TQDMProgressBar(), rate]
    if stop_after is not None:
        callbacks.append(EarlyStopping("validation/loss", patience=stop_after))
    return lightning.Trainer(
        accelerator="cpu",
        strategy="ddp" if processes > 1 else "auto",
        devices=processes,
        max_epochs=-1,
        max_steps=-1 if steps is None else steps,
        val_check_interval=validate_every,
        check_val_every_n_epoch=1 if validate_every is None else None,
        max_time=None if minutes is None else timedelta(minutes=minutes),
        callbacks=callbacks,
        logger=[CSVLogger(folder, name="csv"), TensorBoardLogger(folder, name="tensorboard")],
        log_every_n_steps=1,
        num_sanity_val_steps=0,
        enable_model_summary=False,
    )


class _SaveAtTheEnd(Callback):
    """Save the last step too, which need not be one that was validated."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def on_train_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        trainer.save_checkpoint(self.path)


class Phase(NamedTuple):
    """A part of a training.

    Attributes:
        data: what it sees.
        until: the step at which it ends, counted from the start of the training.
    """

    data: DataLoader[Any]
    until: int


def fit_phases(
    module: NJFTraining,
    folder: Path,
    phases: Sequence[Phase],
    validation: DataLoader[Any],
    *,
    validate_every: int,
) -> None:
    """Train on one kind of batches after another, as one training: one optimizer, one schedule.

    Repeated after an interruption, it goes on from the last checkpoint, in whatever phase that is.

    Args:
        module: of as many `steps` as the last phase ends at.
        folder: for logs and checkpoints, as of `make_trainer`.
        phases: in their order.
        validation: what every phase is validated on.
        validate_every: so many steps; the best checkpoint is the best of those.
    """
    for phase in phases:
        checkpoint = last_checkpoint(folder)
        done = torch.load(checkpoint, weights_only=False)["global_step"] if checkpoint else 0
        if done < phase.until:
            trainer = make_trainer(folder, steps=phase.until, validate_every=validate_every)
            trainer.fit(module, phase.data, validation, ckpt_path=checkpoint)


def last_checkpoint(folder: Path) -> Path | None:
    """The newest checkpoint in a folder of `make_trainer`, or None."""
    path = folder / "checkpoints" / "last.ckpt"
    return path if path.exists() else None


def finished(folder: Path, steps: int) -> bool:
    """Whether a training in a folder of `make_trainer` has taken so many steps."""
    path = last_checkpoint(folder)
    return path is not None and torch.load(path, weights_only=False)["global_step"] >= steps


def load_checkpoint(path: Path) -> Model:
    """The network in a checkpoint of `NJFTraining`, ready for inference."""
    return NJFTraining.load_from_checkpoint(path, map_location="cpu").model.eval()
