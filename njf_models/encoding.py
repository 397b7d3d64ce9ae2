"""The global code that a map depends on: of the source, of the target, of the user's parameters."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from njf_models.basis_points import BasisEncoder, BasisPlace
from njf_models.pointnet import PointNet
from njf_models.pose_estimator import PoseEstimator
from njf_models.rotation_vectors import rotation_matrices


class CodedModel(nn.Module):
    """A network that maps shapes by a global code; what all models have in common.

    Args:
        point_features: number of features of the points the encoder sees; 0 for no encoder.
        encodes_target: the code is [source code | target code] from one shared encoder, not the
            source's alone.
        code_size: size of one code.
        parameters: number of user parameters appended to the code.
        rotations: whether the parameters are rotation vectors, whose matrices the code has too: a
            chain of joints multiplies matrices, and vectors say so only after an exponential.
        basis: how many basis points the encoder sees a shape from, instead of points on it, which
            PointNet sees; 0 for PointNet.
        basis_at: where basis points are.
        joints: how many rotations a `pose_estimator.PoseEstimator` reads off a shape, from the same
            basis points; the code has them, too. Training leaves it as it is. 0 for none.
        code_scale: factor of what the encoder makes. Its entries are largest values of many points,
            so that all shapes have much in common, and parameters in radians are small beside them.

    Attributes:
        n_basis: as `basis`.
        basis_at: as above.
        code_size: size z of the whole code.
        source_size: how many of its entries are of the source alone; they come first.
        n_matrices: how many matrices less the identity end the code, of rotations: parameters; or
            the target's estimated ones; or the source's, and their inverses, for maps that are
            told nothing.
    """

    def __init__(
        self,
        point_features: int,
        *,
        encodes_target: bool,
        code_size: int,
        parameters: int,
        rotations: bool = False,
        basis: int = 0,
        basis_at: BasisPlace = "box",
        joints: int = 0,
        code_scale: float = 1.0,
    ) -> None:
        super().__init__()
        if rotations and parameters % 3:
            raise ValueError(
                f"rotations are vectors of three parameters each, got {parameters} parameters"
            )
        self.encodes_target, self.rotations = encodes_target, rotations
        self.n_basis, self.basis_at, self.code_scale = basis, basis_at, code_scale
        self.encoder: PointNet | BasisEncoder | None = None
        if point_features:
            self.encoder = (
                BasisEncoder(basis, code_size) if basis else PointNet(point_features, code_size)
            )
        if joints and (parameters or not (point_features and basis)):
            raise ValueError(
                "joints are estimated from basis points, where no parameters tell them; "
                f"got basis={basis}, parameters={parameters}, point_features={point_features}"
            )
        self.estimator = PoseEstimator(basis, joints).requires_grad_(False) if joints else None
        of_shape = code_size if point_features else 0
        of_source = 0 if encodes_target else 18 * joints
        told = (4 if rotations else 1) * parameters
        if encodes_target:
            told += of_shape + 9 * joints
        self.source_size = of_shape + of_source
        self.code_size = self.source_size + told
        self.n_matrices = of_source // 9 or joints or (parameters // 3 if rotations else 0)

    def encode(
        self,
        source: Float[Tensor, "*#batch s f"] | None = None,
        target: Float[Tensor, "*#batch t f"] | None = None,
        parameters: Float[Tensor, "*#batch p"] | None = None,
    ) -> Float[Tensor, "*batch z"]:
        """The global code: what the encoder makes of source and target, and user parameters.

        One source, encoded once, serves a batch of targets or parameters; so do several, each its
        own, where an axis of size one stands for its targets.

        Args:
            source: (…, s, f) what the encoder sees of the sources, if the model has one: points on
                them, or basis points.
            target: (…, t, f) point features of the targets, if it encodes them.
            parameters: (…, p) user parameters, if it has any.
        """
        clouds = [cloud for cloud in (source, target) if cloud is not None]
        expected = 0 if self.encoder is None else 1 + self.encodes_target
        if len(clouds) != expected:
            raise ValueError(
                f"encode: this model encodes {expected} point cloud(s), got {len(clouds)}"
            )
        codes = [] if source is None else [self.encode_source(source)]
        if target is not None or parameters is not None:
            codes.append(self.told(target, parameters))
        batch = torch.broadcast_shapes(*(code.shape[:-1] for code in codes))
        code = torch.cat([code.expand(*batch, -1) for code in codes], dim=-1)
        if code.shape[-1] != self.code_size:
            raise ValueError(
                f"encode: the field expects a code of size {self.code_size}, "
                f"got {code.shape[-1]}; check the number of parameters"
            )
        return code

    def told(
        self,
        target: Float[Tensor, "*#batch t f"] | None,
        parameters: Float[Tensor, "*#batch p"] | None,
    ) -> Float[Tensor, "*batch z"]:
        """What of the code is of the target: from points on it, or from parameters, or both.

        Args:
            target: (…, t, f) point features.
            parameters: (…, p) user parameters.
        """
        codes = [] if target is None else [self._encoded(target)]
        if target is not None and self.estimator is not None:
            codes.append(self.estimator(target).flatten(-3))
        codes += [] if parameters is None else [self._with_matrices(parameters)]
        batch = torch.broadcast_shapes(*(code.shape[:-1] for code in codes))
        return torch.cat([code.expand(*batch, -1) for code in codes], dim=-1)

    def encode_source(self, points: Float[Tensor, "*batch s f"]) -> Float[Tensor, "*batch k"]:
        """What the code has of a source, from what the encoder sees of it.

        Raises:
            ValueError: the model has no encoder.
        """
        code = self._encoded(points)
        if self.estimator is None or self.encodes_target:
            return code
        offsets = self.estimator(points)
        inverses = offsets.mT  # of rotations, and of estimates what a field makes of them
        return torch.cat([code, torch.cat([offsets, inverses], dim=-3).flatten(-3)], dim=-1)

    def _encoded(self, points: Float[Tensor, "*batch s f"]) -> Float[Tensor, "*batch k"]:
        if self.encoder is None:
            raise ValueError("encode_source: this model encodes no shapes")
        code = self.encoder(points)
        return code if self.code_scale == 1 else self.code_scale * code

    def _with_matrices(self, parameters: Float[Tensor, "*batch p"]) -> Float[Tensor, "*batch q"]:
        """The parameters, and the matrices less the identity of the rotations that they are."""
        if not self.rotations:
            return parameters
        matrices = rotation_matrices(parameters.unflatten(-1, (-1, 3)))
        identity = torch.eye(3, dtype=matrices.dtype, device=matrices.device)
        return torch.cat([parameters, (matrices - identity).flatten(-3)], dim=-1)
