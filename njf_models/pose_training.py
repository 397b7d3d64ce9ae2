"""Training a pose estimator on what basis points see of many bodies."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.data import DataLoader

from njf_models.basis_points import reflected_basis
from njf_models.datasets.poses import JOINTS, reflected
from njf_models.datasets.seen_poses import SeenPoses
from njf_models.pose_estimator import PoseEstimator, angles_between
from njf_models.rotation_vectors import rotation_matrices
from njf_models.training import TimedModule, rate_share


class PoseTraining(TimedModule):
    """Mean squares of the matrices' entries, with Adam and a cosine.

    Half of the bodies of a step are mirrored, with their poses.

    Args:
        estimator: arguments of `PoseEstimator` but for the joints.
        learning_rate: at its height.
        steps: of the training.
        warmup: steps in which the rate rises.
    """

    def __init__(
        self,
        estimator: dict[str, Any],
        *,
        learning_rate: float = 2e-3,
        steps: int,
        warmup: int = 100,
    ) -> None:
        super().__init__()
        self.save_hyperparameters()
        self.estimator = PoseEstimator(**estimator, joints=len(JOINTS))
        self.learning_rate, self.steps, self.warmup = learning_rate, steps, warmup

    def training_step(self, batch: SeenPoses, batch_idx: int) -> Tensor:
        """Loss of some bodies, summed over joints, averaged over bodies."""
        features, poses = batch
        mirrored = torch.randint(2, (len(poses), 1)).bool()
        features = reflected_basis(features).where(mirrored[..., None], features).float()
        loss = self._loss(features, reflected(poses).where(mirrored, poses))
        self.log("train/loss", loss, prog_bar=True, on_step=False, on_epoch=True)
        return loss

    def validation_step(self, batch: SeenPoses, batch_idx: int) -> None:
        """Loss, and mean angle in degrees."""
        features, poses = batch[0].float(), batch[1]
        self.log("validation/loss", self._loss(features, poses), prog_bar=True)
        angle = joint_errors(self.estimator, SeenPoses(features, poses)).mean()
        self.log("validation/degrees", angle, prog_bar=True)

    def _loss(self, features: Float[Tensor, "b pairs 8"], poses: Float[Tensor, "b 60"]) -> Tensor:
        targets = rotation_matrices(poses.unflatten(-1, (-1, 3))) - torch.eye(3)
        return (self.estimator(features) - targets).square().sum((-1, -2, -3)).mean()

    def configure_optimizers(self) -> Any:
        """Adam and the schedule of its rate."""
        optimizer = torch.optim.Adam(self.parameters(), lr=self.learning_rate)
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda step: rate_share(step, self.steps, self.warmup)
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


@torch.no_grad()
def joint_errors(estimator: PoseEstimator, seen: SeenPoses) -> Float[Tensor, "n joints"]:
    """Angles between estimated and true rotations of each joint, in degrees."""
    matrices = estimator(seen.features.float()) + torch.eye(3)
    rotations = rotation_matrices(seen.poses.unflatten(-1, (-1, 3)))
    return torch.rad2deg(angles_between(matrices, rotations))


def pose_loader(seen: SeenPoses, batch_size: int, *, shuffle: bool = False) -> DataLoader[Any]:
    """Batches of bodies, indexed at once."""
    n = len(seen.poses)
    order: Any = torch.utils.data.RandomSampler if shuffle else torch.utils.data.SequentialSampler
    batches = torch.utils.data.BatchSampler(order(range(n)), batch_size, drop_last=shuffle)
    return DataLoader(_Rows(seen), sampler=batches, batch_size=None)


class _Rows(torch.utils.data.Dataset[SeenPoses]):
    def __init__(self, seen: SeenPoses) -> None:
        self.seen = seen

    def __len__(self) -> int:
        return len(self.seen.poses)

    def __getitem__(self, rows: list[int]) -> SeenPoses:
        return SeenPoses(*(array[rows] for array in self.seen))
