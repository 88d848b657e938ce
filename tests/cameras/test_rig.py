# SPDX-License-Identifier: BSD-3-Clause
"""Covers rigs: composition of sensor and body poses, its inverse, broadcasting, errors."""

import numpy as np
import pytest

from groma.cameras.rig import Rig, cam_from_world, rig_from_world
from groma.errors import ShapeError

pytestmark = pytest.mark.kernels

IDENTITY = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


def random_poses(rng, *shape):
    quaternion = rng.normal(size=(*shape, 4))
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return np.concatenate([quaternion, rng.normal(size=(*shape, 3))], axis=-1)


def rotation(quaternion):
    """Rotation matrix of a Hamilton quaternion x, y, z, w, written out independently of the library."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def apply(pose, point):
    return rotation(pose[:4]) @ point + pose[4:]


def test_a_point_goes_through_the_rig_to_the_camera():
    rng = np.random.default_rng(0)
    extrinsics, poses, point = random_poses(rng, 5), random_poses(rng, 5), rng.normal(size=3)
    for whole, outer, inner in zip(cam_from_world(extrinsics, poses), extrinsics, poses, strict=True):
        np.testing.assert_allclose(apply(whole, point), apply(outer, apply(inner, point)), rtol=0, atol=1e-14)


def test_rig_pose_from_camera_pose():
    rng = np.random.default_rng(1)
    extrinsics, poses, point = random_poses(rng, 4), random_poses(rng, 4), rng.normal(size=3)
    back = rig_from_world(extrinsics, cam_from_world(extrinsics, poses))
    for first, second in zip(back, poses, strict=True):
        np.testing.assert_allclose(apply(first, point), apply(second, point), rtol=0, atol=1e-14)


def test_all_sensors_of_all_frames():
    rng = np.random.default_rng(2)
    rig, frames = Rig(random_poses(rng, 3)), random_poses(rng, 2, 4)
    assert len(rig) == 3
    poses = rig.cam_from_world(frames)
    assert poses.shape == (2, 4, 3, 7)
    np.testing.assert_array_equal(poses[1, 2, 0], cam_from_world(rig.sensor_from_rig[0], frames[1, 2]))
    assert rig.cam_from_world(frames[0, 0]).shape == (3, 7)


def test_single_camera():
    pose = random_poses(np.random.default_rng(3), 2)
    np.testing.assert_allclose(Rig.single().cam_from_world(pose)[:, 0], pose, rtol=0, atol=1e-15)


def test_a_rig_does_not_change():
    given = np.tile(IDENTITY, (2, 1))
    rig = Rig(given)
    given[0, 4] = 5.0
    assert rig.sensor_from_rig[0, 4] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        rig.sensor_from_rig[0, 4] = 1.0


def test_messages():
    with pytest.raises(ShapeError, match=r"sensor_from_rig must have shape \(S, 7\); got \(7,\)"):
        Rig(IDENTITY)
    with pytest.raises(ShapeError, match=r"cam_from_rig must have shape \(\.\.\., 7\)"):
        cam_from_world(np.ones(6), IDENTITY)
    with pytest.raises(ShapeError, match=r"rig_from_world must have shape \(\.\.\., 7\)"):
        Rig.single().cam_from_world(np.eye(4))
    with pytest.raises(ShapeError, match=r"cam_from_world must have shape \(\.\.\., 7\)"):
        rig_from_world(IDENTITY, np.ones(3))
    with pytest.raises(ShapeError, match=r"broadcast.*\(2, 7\).*\(3, 7\)"):
        cam_from_world(np.tile(IDENTITY, (2, 1)), np.tile(IDENTITY, (3, 1)))
