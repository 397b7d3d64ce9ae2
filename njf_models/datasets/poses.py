"""Random human poses inside the limits of the joints, as rotation vectors.

A pose is relative to a standing body with the arms half lowered (an A-pose), whose axes are x to
its left, y to its back and z up. Each of twenty joints turns everything that hangs on it about an
axis of that frame. Angles are in radians, but in degrees in the table of limits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

Limits = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]

# Lowest and highest component of the rotation vector about x, y and z; arms and legs on the left.
LIMITS: dict[str, Limits] = {
    "root": ((-8.0, 8.0), (-8.0, 8.0), (0.0, 0.0)),
    "spine05": ((-5.0, 15.0), (-6.0, 6.0), (-8.0, 8.0)),
    "spine03": ((-8.0, 20.0), (-8.0, 8.0), (-10.0, 10.0)),
    "spine01": ((-8.0, 15.0), (-8.0, 8.0), (-10.0, 10.0)),
    "neck01": ((-12.0, 15.0), (-10.0, 10.0), (-20.0, 20.0)),
    "head": ((-20.0, 18.0), (-12.0, 12.0), (-30.0, 30.0)),
    "clavicle": ((-5.0, 5.0), (-14.0, 6.0), (-8.0, 8.0)),
    "upperarm01": ((-30.0, 30.0), (-110.0, 35.0), (-70.0, 25.0)),
    "wrist": ((-15.0, 15.0), (-25.0, 25.0), (-20.0, 20.0)),
    "upperleg01": ((-95.0, 20.0), (-35.0, 8.0), (-20.0, 20.0)),
    "foot": ((-25.0, 20.0), (-8.0, 8.0), (-8.0, 8.0)),
}
ELBOW_LIMIT, KNEE_LIMIT = 125.0, 120.0
_ELBOW_AXIS = np.array([-1.0, 0.0, -1.0]) / np.sqrt(2)  # of the left elbow; the knee's is x
_RELAXED_ELBOW = 20.0  # the most frequent angle
_MIRROR = np.array([1.0, -1.0, -1.0])  # a rotation vector is a pseudovector: x = 0 keeps its x

_TRUNK = ("root", "spine05", "spine03", "spine01", "neck01", "head")
_LIMBS = ("clavicle", "upperarm01", "lowerarm01", "wrist", "upperleg01", "lowerleg01", "foot")

JOINTS: tuple[str, ...] = _TRUNK + tuple(f"{name}.{side}" for side in "LR" for name in _LIMBS)
"""The joints of a pose, by anny's names, in the order of its rows."""


class Freedom(NamedTuple):
    """One of the angles that poses are drawn by.

    Attributes:
        joint: whose, one of `JOINTS`.
        name: of the angle.
        axis: (3,) unit vector that it turns about.
        low: its least value, in degrees.
        high: its greatest.
    """

    joint: str
    name: str
    axis: Float[np.ndarray, "3"]
    low: float
    high: float


def freedoms() -> list[Freedom]:
    """The angles of all joints, by joint: elbow and knee bend, others turn about three axes.

    The rotation vector of a joint is the sum of its angles times their axes. An axis about which a
    joint doesn't turn is left out.
    """
    hinges = {
        "lowerarm01": (_ELBOW_AXIS, ELBOW_LIMIT),
        "lowerleg01": (np.array([1.0, 0.0, 0.0]), KNEE_LIMIT),
    }
    angles = []
    for joint in JOINTS:
        name, _, side = joint.partition(".")
        flip = _MIRROR if side == "R" else np.ones(3)
        if name in hinges:
            axis, limit = hinges[name]
            angles.append(Freedom(joint, "bend", flip * axis, 0.0, limit))
            continue
        for i, (low, high) in enumerate(LIMITS[name]):
            if low < high:
                ends = sorted((flip[i] * low, flip[i] * high))
                angles.append(Freedom(joint, "xyz"[i], np.eye(3)[i], *ends))
    return angles


def sample_pose(rng: np.random.Generator, heading: float = 0.0) -> Float[np.ndarray, "joints=20 3"]:
    """A random pose: each angle most often near rest, none beyond its limit.

    Joints are drawn independently, but for the knee, which bends more where the hip does, so that
    the feet stay under the body. Nothing keeps limbs out of the body: `bodies` screens poses.

    Args:
        rng: source of randomness.
        heading: largest turn of the whole body about the vertical, to either side; uniform.

    Returns:
        (20, 3) rotation vectors of `JOINTS`.
    """
    pose = {name: _triangular(rng, LIMITS[name]) for name in _TRUNK}
    for side in "LR":
        limb = {name: _triangular(rng, LIMITS[name]) for name in _LIMBS if name in LIMITS}
        bend = rng.triangular(0, _RELAXED_ELBOW, ELBOW_LIMIT)
        limb["lowerarm01"] = bend * _ELBOW_AXIS
        knee = rng.triangular(0, 0, KNEE_LIMIT) / 2
        knee += max(0.0, -limb["upperleg01"][0]) * rng.uniform(0.3, 1.2)
        limb["lowerleg01"] = np.array([min(knee, KNEE_LIMIT), 0.0, 0.0])
        flip = _MIRROR if side == "R" else np.ones(3)
        pose |= {f"{name}.{side}": flip * vector for name, vector in limb.items()}
    vectors = np.deg2rad(np.stack([pose[name] for name in JOINTS]))
    vectors[0, 2] = rng.uniform(-heading, heading)
    return vectors


def reflected(poses: Float[Tensor, "*batch 60"]) -> Float[Tensor, "*batch 60"]:
    """The poses of a body's mirror image: left and right change places."""
    names = [name.translate(str.maketrans("LR", "RL")) if "." in name else name for name in JOINTS]
    partners = [JOINTS.index(name) for name in names]
    mirror = torch.from_numpy(_MIRROR).to(poses)
    return (poses.unflatten(-1, (-1, 3))[..., partners, :] * mirror).flatten(-2)


def _triangular(rng: np.random.Generator, limits: Limits) -> np.ndarray:
    """A rotation vector in degrees, each component most often zero."""
    return np.array([rng.triangular(low, 0, high) if low < high else 0.0 for low, high in limits])
