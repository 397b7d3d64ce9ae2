"""Training a Neural Jacobian Field with Lightning: batches, the training module, the trainer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

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
from njf_models.features import Shape, point_features
from njf_models.losses import LOSSES, Loss
from njf_models.metrics import count_flips
from njf_models.njf import NeuralJacobianField, Prediction


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
    """Examples of different shapes packed into one: their disjoint union, points stacked.

    Attributes:
        shape: the union of the sources.
        points: (batch, s, f) point features of each source.
        target: (n, c) target images of all vertices.
    """

    shape: Shape
    points: Float[Tensor, "batch s f"]
    target: Float[Tensor, "n c"]

    @classmethod
    def pack(cls, examples: Sequence[Example]) -> Batch:
        """Concatenate the shapes, so that one pass of the network serves all their faces."""
        return cls(
            Shape.concatenate([example.shape for example in examples]),
            torch.stack([example.points for example in examples]),
            torch.cat([example.target for example in examples]),
        )


class UVExamples(Dataset[Example]):
    """UV patches as training examples, each prepared at its first use and kept.

    Args:
        patches: the training pairs.
        n_points: how many points the encoder sees.
        resample: draw new points at each access (training) or always the same (evaluation).
        use_wks: whether the network sees the wave-kernel signature.
    """

    def __init__(
        self,
        patches: Sequence[UVPatch],
        *,
        n_points: int = 1024,
        resample: bool = False,
        use_wks: bool = True,
    ) -> None:
        self.patches = patches
        self.n_points, self.resample, self.use_wks = n_points, resample, use_wks
        self._shapes: dict[int, Shape] = {}

    def __len__(self) -> int:
        return len(self.patches)

    def __getitem__(self, index: int) -> Example:
        patch = self.patches[index]
        wks = patch.wks if self.use_wks else None
        if index not in self._shapes:
            self._shapes[index] = Shape.prepare(patch.mesh, wks)
        generator = None if self.resample else torch.Generator().manual_seed(index)
        samples = dp.sample_surface(patch.mesh, self.n_points, generator=generator)
        points = point_features(patch.mesh, samples, wks).float()
        return Example(self._shapes[index], points, patch.uv.float())


class NJFTraining(lightning.LightningModule):
    """Supervised training: Adam, 1e-3 falling to 1e-4 when the validation loss stops improving.

    Args:
        model: arguments of `NeuralJacobianField`, kept in the checkpoint.
        loss: a key of `losses.LOSSES`, "paper" or "official".
        learning_rate: of Adam, at the start.
        patience: validations without improvement before the rate falls to a tenth.
    """

    def __init__(
        self,
        model: dict[str, Any],
        *,
        loss: str = "paper",
        learning_rate: float = 1e-3,
        patience: int = 10,
    ) -> None:
        super().__init__()
        if loss not in LOSSES:
            raise ValueError(f"NJFTraining: loss must be one of {sorted(LOSSES)}, got {loss!r}")
        self.save_hyperparameters()
        self.model = NeuralJacobianField(**model)
        self.loss, self.learning_rate, self.patience = LOSSES[loss], learning_rate, patience

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Loss of one packed batch."""
        loss = self._predict(batch)[1].total
        size = len(batch.points)
        self.log("train/loss", loss, prog_bar=True, on_step=False, on_epoch=True, batch_size=size)
        return loss

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Losses and flips per shape of one packed batch."""
        prediction, loss = self._predict(batch)
        size = len(batch.points)
        values = {f"validation/{name}": value for name, value in loss._asdict().items()}
        if self.model.output_dim == 2:
            J = dp.jacobians(batch.shape.mesh, prediction.vertices)
            values["validation/flips"] = count_flips(J).float() / size
        self.log("validation/loss", loss.total, prog_bar=True, batch_size=size)
        self.log_dict(values, batch_size=size)

    def transfer_batch_to_device(
        self, batch: Batch, device: torch.device, dataloader_idx: int
    ) -> Batch:
        """The batch as it is: it lives where its factors do."""
        return batch

    def _predict(self, batch: Batch) -> tuple[Prediction, Loss]:
        prediction = self.model(batch.shape, self.model.encode(batch.points))
        return prediction, self.loss(batch.shape, prediction, batch.target)

    def configure_optimizers(self) -> Any:
        """Adam with the paper's schedule."""
        optimizer = torch.optim.Adam(self.parameters(), lr=self.learning_rate)
        schedule = torch.optim.lr_scheduler.ReduceLROnPlateau(
            optimizer, factor=0.1, patience=self.patience, min_lr=self.learning_rate / 10
        )
        scheduler = {"scheduler": schedule, "monitor": "validation/loss"}
        return {"optimizer": optimizer, "lr_scheduler": scheduler}


def loader(examples: UVExamples, batch_size: int, *, shuffle: bool = False) -> DataLoader[Example]:
    """Packed batches. Factors live in this process, so there are no workers."""
    return DataLoader(examples, batch_size=batch_size, shuffle=shuffle, collate_fn=Batch.pack)


def make_trainer(
    folder: Path, *, minutes: float | None = None, stop_after: int | None = None
) -> lightning.Trainer:
    """A trainer that shows progress, logs to CSV and TensorBoard, and can be stopped and resumed.

    Pass `ckpt_path=last_checkpoint(folder)` to `fit` to go on where an earlier run ended, also one
    that was interrupted.

    Args:
        folder: where logs and checkpoints go.
        minutes: stop after this time; None for no limit.
        stop_after: stop after this many validations without improvement; None for no such limit.
    """
    checkpoints = ModelCheckpoint(
        dirpath=folder / "checkpoints",
        filename="best",
        monitor="validation/loss",
        save_last=True,
        save_on_exception=True,
        enable_version_counter=False,
    )
    rate = LearningRateMonitor(logging_interval="epoch")
    callbacks: list[Callback] = [checkpoints, TQDMProgressBar(), rate]
    if stop_after is not None:
        callbacks.append(EarlyStopping("validation/loss", patience=stop_after))
    return lightning.Trainer(
        accelerator="cpu",
        max_epochs=-1,
        max_time=None if minutes is None else timedelta(minutes=minutes),
        callbacks=callbacks,
        logger=[CSVLogger(folder, name="csv"), TensorBoardLogger(folder, name="tensorboard")],
        log_every_n_steps=1,
        num_sanity_val_steps=0,
        enable_model_summary=False,
    )


def last_checkpoint(folder: Path) -> Path | None:
    """The newest checkpoint in a folder of `make_trainer`, or None."""
    path = folder / "checkpoints" / "last.ckpt"
    return path if path.exists() else None


def load_checkpoint(path: Path) -> NeuralJacobianField:
    """The network in a checkpoint of `NJFTraining`, ready for inference."""
    return NJFTraining.load_from_checkpoint(path, map_location="cpu").model.eval()
