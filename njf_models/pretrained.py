"""Trained weights: those shipped with this package, and checkpoints of the authors' code."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, Literal, overload

from torch import Tensor

import diffpoisson as dp
from njf_models.njf import NeuralJacobianField
from njf_models.repose_network import ReposeNetwork
from njf_models.uv_network import UVNetwork

_WEIGHTS = Path(__file__).parent / "weights"

_FIELD = "per_face_decoder."
_ENCODERS = "encoder._DeformationEncoder__module_list."
_POINTNET = "._PointNetEncoder__pointnet."


@overload
def load_pretrained(name: Literal["uv"] = "uv") -> UVNetwork: ...
@overload
def load_pretrained(name: Literal["repose", "repose-any"]) -> ReposeNetwork: ...
@overload
def load_pretrained(name: str) -> UVNetwork | ReposeNetwork: ...
def load_pretrained(name: str = "uv") -> UVNetwork | ReposeNetwork:
    """A trained network that comes with this package; `card` says what it was trained on.

    Args:
        name: "uv", for maps of surfaces to the plane; "uv-pointnet", the same without eigenpairs;
            "repose", for bodies from rest to poses; or "repose-any", from any pose.

    Raises:
        ValueError: there are no weights of that name.
    """
    return _load(name)


@cache
def _load(name: str) -> UVNetwork | ReposeNetwork:
    kind = ReposeNetwork if name.startswith("repose") else UVNetwork
    return kind.load(_file(name, ".safetensors"))


def load_uv_network(weights: Path | str) -> UVNetwork:
    """A network for UV maps, of this package or one's own.

    Args:
        weights: a name as for `load_pretrained`; or a file, `.safetensors` of `UVNetwork.save` or
            `.ckpt` of `njf train`.

    Raises:
        ValueError: there is no such file and no such name, or it is not for UV maps.
    """
    path = Path(weights)
    if path.suffix and not path.is_file():
        raise ValueError(f"there is no file {path}")
    if path.suffix == ".ckpt":
        return UVNetwork.from_checkpoint(path)
    network = UVNetwork.load(path) if path.suffix else load_pretrained(str(weights))
    if not isinstance(network, UVNetwork):
        raise ValueError(f"the weights {str(weights)!r} are not for UV maps; use 'uv'")
    return network


def card(name: str = "uv") -> dict[str, Any]:
    """The card of trained weights: data, licences, split, training and measured errors.

    Raises:
        ValueError: there are no weights of that name.
    """
    return dict(json.loads(_file(name, ".json").read_text()))


def parameterize(
    mesh: dp.Mesh, *, model: Path | str | UVNetwork = "uv", **options: Any
) -> dp.UVMap:
    """A flip-free UV map of a surface, from a network's prediction for each chart.

    `diffpoisson.parameterize(mesh, network.start, ...)`: the prediction is repaired where it flips
    triangles, polished by SLIM, and replaced by Tutte's embedding where nothing mends it. Charts
    that are whole closed surfaces, cut open, have no mean normal and so no pose for the network to
    see them in: they start from Tutte's embedding.

    Args:
        mesh: a surface in space, whose components are topological disks unless `cut`.
        model: a network; or weights, by a name or a file as for `load_uv_network`.
        options: of `diffpoisson.parameterize`: cut, injective, tolerance, max_iterations.

    Raises:
        MeshError: see there.
        ValueError: there are no weights of that name, or they are not for UV maps.
    """
    network = model if isinstance(model, UVNetwork) else load_uv_network(model)
    return dp.parameterize(mesh, network.start, **options)


def _file(name: str, suffix: str) -> Path:
    names = sorted(path.stem for path in _WEIGHTS.glob("*.safetensors"))
    if name not in names:
        raise ValueError(f"there are no weights {name!r}, but {', '.join(names) or 'none'}")
    return _WEIGHTS / f"{name}{suffix}"


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
