# SPDX-License-Identifier: BSD-3-Clause
"""A camera in a room of points and lines, and exact matches of it."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from groma.evaluation import cabinet
from groma.geometry import quaternion, so3
from groma.io import read_scene, write_scene
from groma.localization.pose.absolute_pose import estimate_absolute_pose
from groma.localization.pose.camera import QueryCamera

CAMERA = QueryCamera("PINHOLE", np.array([600.0, 610.0, 330.0, 235.0]), 640, 480)


@dataclass(frozen=True)
class World:
    """Matches without noise, and the pose that they are of."""

    pose: np.ndarray
    points2d: np.ndarray
    points3d: np.ndarray
    segments2d: np.ndarray
    segments3d: np.ndarray

    def errors(self, pose):
        """Distance of the centres, and angle in radians."""
        R, R_true = (quaternion.to_matrix(one[None, :4])[0] for one in (pose, self.pose))
        shift = -R.T @ pose[4:] + R_true.T @ self.pose[4:]
        return np.linalg.norm(shift), np.linalg.norm(so3.log((R @ R_true.T)[None])[0])


def project(camera, pose, places):
    """Pixels by the camera's own model."""
    return camera.project(pose, places.reshape(-1, 3)).reshape(*places.shape[:-1], 2)


def make_world(rng, points=60, lines=20, camera=CAMERA):
    """Landmarks 3 to 7 units before a camera of any pose; segments are pieces of the images of their lines."""
    turn = so3.exp(rng.normal(0.0, 1.0, (1, 3)))
    pose = np.concatenate([quaternion.from_matrix(turn)[0], rng.normal(0.0, 2.0, 3)])

    def places(count):
        pixels = np.column_stack(
            [rng.uniform(20, camera.width - 20, count), rng.uniform(20, camera.height - 20, count)]
        )
        rays = camera.kind.unproject(camera.params, pixels)
        inside = rays / rays[:, 2:] * rng.uniform(3.0, 7.0, (count, 1))
        return (inside - pose[4:]) @ turn[0]

    X = places(points)
    ends = places(2 * lines).reshape(lines, 2, 3)
    share = np.sort(rng.uniform(-0.05, 1.05, (lines, 2, 1)), axis=1)
    pieces = ends[:, :1] + share * (ends[:, 1:] - ends[:, :1])  # a detected segment ends elsewhere than the line
    return World(pose, project(camera, pose, X), X, project(camera, pose, pieces), ends)


def pose_of(world, kinds, camera=CAMERA, **options):
    """Estimate from points, lines or both."""
    points = (world.points2d, world.points3d) if "points" in kinds else (None, None)
    lines = (world.segments2d, world.segments3d) if "lines" in kinds else (None, None)
    return estimate_absolute_pose(camera, *points, *lines, **options)


#: Images around one corner of the cabinet; every third is a query.
FRAMES = [f"{number:04d}.jpg" for number in range(24, 39)]
QUERIES = FRAMES[1::3]


def cabinet_in(folder: Path) -> Path:
    """Write to a folder a map of some frames of the cabinet, by motion capture, their images, and the others."""
    scene = read_scene(cabinet.folder() / "model")
    names = list(scene.images.names)
    rows = [names.index(name) for name in FRAMES if name not in QUERIES]
    write_scene(scene.subset(rows), folder / "map.npz")
    for kind, chosen in (("images", [name for name in FRAMES if name not in QUERIES]), ("queries", QUERIES)):
        (folder / kind).mkdir()
        for name in chosen:
            shutil.copy(cabinet.folder() / "images" / name, folder / kind / name)
    return folder
