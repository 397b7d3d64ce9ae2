"""Random poses stay inside the limits of the joints, and left is the mirror image of right."""

from __future__ import annotations

import numpy as np
import pytest

from njf_models.datasets.poses import ELBOW_LIMIT, JOINTS, KNEE_LIMIT, LIMITS, sample_pose

N = 4000


@pytest.fixture(scope="module")
def poses():
    rng = np.random.default_rng(0)
    return np.rad2deg(np.stack([sample_pose(rng) for _ in range(N)]))


def joint(poses, name):
    return poses[:, JOINTS.index(name)]


def test_every_component_stays_in_its_limits_and_nearly_reaches_them(poses):
    for name, limits in LIMITS.items():
        left = joint(poses, name if name in JOINTS else f"{name}.L")
        for component, (low, high) in zip(left.T, limits, strict=True):
            assert low <= component.min() <= 0.9 * low + 1e-9
            assert 0.9 * high - 1e-9 <= component.max() <= high


def test_right_is_distributed_as_the_mirror_image_of_left(poses):
    for name in JOINTS:
        if name.endswith(".L"):
            left, right = joint(poses, name), joint(poses, name[:-1] + "R") * [1, -1, -1]
            error = np.sqrt((left.var(0) + right.var(0)) / N)
            assert (np.abs(left.mean(0) - right.mean(0)) <= 5 * error).all()
            assert np.allclose(left.std(0), right.std(0), rtol=0.1)
            assert name.startswith("lower") or (np.abs(left - right).max(0) > 1).all()


def test_elbows_and_knees_are_hinges_that_bend_one_way(poses):
    elbow, knee = joint(poses, "lowerarm01.L"), joint(poses, "lowerleg01.L")
    angle = np.linalg.norm(elbow, axis=1)
    assert np.allclose(elbow, -angle[:, None] * np.array([1, 0, 1]) / np.sqrt(2))
    assert 0.9 * ELBOW_LIMIT < angle.max() <= ELBOW_LIMIT
    assert (knee[:, 1:] == 0).all()
    assert knee[:, 0].min() >= 0
    assert 0.9 * KNEE_LIMIT < knee[:, 0].max() <= KNEE_LIMIT


def test_knees_bend_with_the_hips(poses):
    raised = -joint(poses, "upperleg01.L")[:, 0]
    knee = joint(poses, "lowerleg01.L")[:, 0]
    assert knee[raised > 60].mean() > 2 * knee[raised < 0].mean()


def test_the_heading_alone_turns_the_root_about_the_vertical():
    straight = sample_pose(np.random.default_rng(3))
    turned = [sample_pose(np.random.default_rng(s), heading=np.pi)[0, 2] for s in range(200)]
    assert straight[0, 2] == 0
    assert np.ptp(turned) > 6
    other = sample_pose(np.random.default_rng(3), heading=np.pi)
    other[0, 2] = 0
    assert (other == straight).all()
