"""The global code that a map depends on: of the source, of the target, of the user's parameters."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from njf_models.pointnet import PointNet


class CodedModel(nn.Module):
    """A network that maps shapes by a global code; what all models have in common.

    Args:
        point_features: number of features of the points the encoder sees; 0 for no encoder.
        encodes_target: the code is [source code | target code] from one shared encoder, not the
            source's alone.
        code_size: size of one code.
        parameters: number of user parameters appended to the code.

    Attributes:
        code_size: size z of the whole code.
    """

    def __init__(
        self, point_features: int, *, encodes_target: bool, code_size: int, parameters: int
    ) -> None:
        super().__init__()
        self.encodes_target = encodes_target
        self.encoder = PointNet(point_features, code_size) if point_features else None
        n_codes = (1 + encodes_target) if point_features else 0
        self.code_size = n_codes * code_size + parameters

    def encode(
        self,
        source: Float[Tensor, "*#batch s f"] | None = None,
        target: Float[Tensor, "*#batch t f"] | None = None,
        parameters: Float[Tensor, "*#batch p"] | None = None,
    ) -> Float[Tensor, "*batch z"]:
        """The global code: PointNet of source and target, and user parameters, side by side.

        One source, encoded once, serves a batch of targets or parameters; so do several, each its
        own, where an axis of size one stands for its targets.

        Args:
            source: (…, s, f) point features of the sources, if the model has an encoder.
            target: (…, t, f) point features of the targets, if it encodes them.
            parameters: (…, p) user parameters, if it has any.
        """
        clouds = [cloud for cloud in (source, target) if cloud is not None]
        expected = 0 if self.encoder is None else 1 + self.encodes_target
        if len(clouds) != expected:
            raise ValueError(
                f"encode: this model encodes {expected} point cloud(s), got {len(clouds)}"
            )
        codes = [self.encoder(cloud) for cloud in clouds] if self.encoder is not None else []
        codes += [] if parameters is None else [parameters]
        batch = torch.broadcast_shapes(*(code.shape[:-1] for code in codes))
        code = torch.cat([code.expand(*batch, -1) for code in codes], dim=-1)
        if code.shape[-1] != self.code_size:
            raise ValueError(
                f"encode: the field expects a code of size {self.code_size}, "
                f"got {code.shape[-1]}; check the number of parameters"
            )
        return code

    def encode_pairs(
        self, points: Float[Tensor, "b s f"], partners: Int[Tensor, "b t"]
    ) -> Float[Tensor, "b t z"]:
        """The codes of maps among b shapes, each of which is encoded once.

        Args:
            points: (b, s, f) point features of the shapes.
            partners: (b, t) which of them the targets of each are.

        Raises:
            ValueError: the model's code is not [source code | target code].
        """
        if self.encoder is None or not self.encodes_target:
            raise ValueError("encode_pairs: this needs a model that encodes source and target")
        codes = self.encoder(points)
        return torch.cat([codes[:, None].expand(-1, partners.shape[1], -1), codes[partners]], -1)
