"""Trained weights: loading state dicts, also in the layout of the authors' checkpoints."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from njf_models.njf import NeuralJacobianField

_FIELD = "per_face_decoder."
_ENCODERS = "encoder._DeformationEncoder__module_list."
_POINTNET = "._PointNetEncoder__pointnet."


def from_reference_state_dict(state_dict: Mapping[str, Tensor]) -> NeuralJacobianField:
    """The network of a checkpoint of the authors' code, from its state dict.

    Sizes and dtype are read off the weights. The encoder of source and target is one network that
    such a checkpoint stores twice.

    Args:
        state_dict: keys `per_face_decoder.*` and, if shapes are encoded,
            `encoder._DeformationEncoder__module_list.{0,1}._PointNetEncoder__pointnet.*`.

    Raises:
        ValueError: missing or unexpected keys, or two encoders that differ.
    """
    field = _strip(state_dict, _FIELD)
    sources, targets = (_strip(state_dict, f"{_ENCODERS}{i}{_POINTNET}") for i in (0, 1))
    n_read = len(field) + len(sources) + len(targets)
    if not field or n_read < len(state_dict):
        known = (_FIELD, f"{_ENCODERS}0{_POINTNET}", f"{_ENCODERS}1{_POINTNET}")
        strangers = sorted(key for key in state_dict if not key.startswith(known))
        raise ValueError(
            f"from_reference_state_dict: expected keys '{_FIELD}*' and '{_ENCODERS}*', "
            f"got {len(field)} and {n_read - len(field)} of them, and unknown {strangers[:5]}"
        )
    if targets and not all(sources[key].equal(targets[key]) for key in sources):
        raise ValueError(
            "from_reference_state_dict: source and target encoders differ, but share weights"
        )
    first = field["0.weight"]
    code_size = len(sources["conv4.weight"]) if sources else 0
    n_codes = bool(sources) + bool(targets)
    point_features = sources["conv1.weight"].shape[1] if sources else 0
    # An encoder that reads k features per point goes with k features per face; the rest is the
    # code.
    face_features = point_features or 6
    model = NeuralJacobianField(
        face_features,
        point_features,
        encodes_target=bool(targets),
        code_size=code_size,
        parameters=first.shape[1] - face_features - n_codes * code_size,
        centering="vertex",
        width=len(first),
    ).to(first.dtype)
    ours = {f"field.layers.{key}": value for key, value in field.items()}
    ours |= {f"encoder.layers.{key.replace('bn', 'norm')}": value for key, value in sources.items()}
    model.load_state_dict(ours)
    return model


def _strip(state_dict: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {key[len(prefix) :]: v for key, v in state_dict.items() if key.startswith(prefix)}
