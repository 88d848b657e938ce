# SPDX-License-Identifier: BSD-3-Clause
"""Cameras around a cloud of points, in plain NumPy: what the tests of foreign formats write their files from.

Nothing here is groma's: axes are x right, y down, z forward; rotations are matrices; pixels are not rounded.
"""

from dataclasses import dataclass

import numpy as np

from groma import cameras
from groma.geometry import se3
from groma.scene import Scene

WIDTH, HEIGHT = 640, 480


@dataclass
class Views:
    """Poses (N, 3, 3) and (N, 3), points (P, 3), the points in each camera (N, P, 3) and their colours (P, 3)."""

    rotation: np.ndarray
    translation: np.ndarray
    points: np.ndarray
    in_cam: np.ndarray
    color: np.ndarray

    @property
    def center(self) -> np.ndarray:
        return -np.einsum("nji,nj->ni", self.rotation, self.translation)


def views(count: int = 4, num_points: int = 12, seed: int = 0) -> Views:
    """Return cameras on an arc that look at points within a unit of the origin, none of them upright."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (num_points, 3))
    rotation, translation = [], []
    for row in range(count):
        angle = 0.4 * row
        center = np.array([4.0 * np.sin(angle), -0.5 + 0.3 * row, -4.0 * np.cos(angle)])
        forward = -center / np.linalg.norm(center)
        right = np.cross([0.1 * row, 1.0, 0.2], forward)
        right /= np.linalg.norm(right)
        turn = np.array([right, np.cross(forward, right), forward])
        rotation.append(turn)
        translation.append(-turn @ center)
    rotation, translation = np.array(rotation), np.array(translation)
    in_cam = np.einsum("nij,pj->npi", rotation, points) + translation[:, None]
    return Views(rotation, translation, points, in_cam, rng.integers(0, 256, (num_points, 3)))


def errors(scene: Scene) -> np.ndarray:
    """Return how far each observation of a scene lies from where its own cameras see its point, pixels."""
    seen = scene.point_observations
    in_cam = se3.transform_points(scene.cam_from_world[seen.image_idx], scene.points.xyz[seen.point_idx])
    camera = scene.images.camera_idx[seen.image_idx]
    found = np.full(len(seen), np.nan)
    for row in range(scene.num_cameras):
        mine = camera == row
        model = cameras.model(scene.cameras.models[row])
        pixel = model.project(scene.cameras.params_of(row), in_cam[mine])
        found[mine] = np.linalg.norm(pixel - seen.pixel[mine], axis=1)
    return found


def check_poses(scene: Scene, true: Views, rows: list[int] | None = None, tolerance: float = 1e-9) -> None:
    """Assert that the poses of a scene are the true ones."""
    rows = list(range(len(true.rotation))) if rows is None else rows
    matrices = se3.to_matrix(scene.cam_from_world)
    np.testing.assert_allclose(matrices[:, :3, :3], true.rotation[rows], atol=tolerance)
    np.testing.assert_allclose(matrices[:, :3, 3], true.translation[rows], atol=tolerance)


def photographs(folder, names: list[str], size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
    """Write black images."""
    import cv2

    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), np.zeros((size[1], size[0]), np.uint8))
