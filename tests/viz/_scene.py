# SPDX-License-Identifier: BSD-3-Clause
"""A small exact scene of points, lines and one plane, seen by two cameras of different models."""

import numpy as np

from groma import cameras
from groma.geometry import se3
from groma.localization.stored import StoredImage
from groma.scene import Cameras, LineObservations, Lines, Planes, PointObservations, Points, Relations, Scene
from groma.viz.report.covariances import LandmarkCovariances

PINHOLE = [500.0, 510.0, 320.0, 240.0]
OPENCV = [400.0, 405.0, 310.0, 250.0, 0.05, -0.02, 0.001, -0.002]


def exact_scene(names=("first.jpg", "second.jpg"), seed=0) -> Scene:
    """Every observation is the exact image of its landmark."""
    rng = np.random.default_rng(seed)
    models = ("PINHOLE", "OPENCV")
    params = np.zeros((2, 8))
    params[0, :4], params[1] = PINHOLE, OPENCV
    poses = se3.exp(np.array([[0.1, -0.1, 4.0, 0.05, 0.1, -0.02], [-0.3, 0.2, 4.5, -0.1, 0.15, 0.2]]))
    xyz = rng.uniform(-1, 1, (12, 3))
    xyz[:5, 2] = 0.25
    segments = rng.uniform(-1, 1, (4, 2, 3))
    segments[0, :, 2] = 0.25

    def image_of(image: int, places: np.ndarray) -> np.ndarray:
        model = cameras.model(models[image])
        pose = se3.to_matrix(poses[image : image + 1])[0]
        return model.project(params[image, : model.num_parameters], places @ pose[:3, :3].T + pose[:3, 3])

    pixels = np.concatenate([image_of(i, xyz) for i in (0, 1)])
    ends = np.concatenate([image_of(i, segments.reshape(-1, 3)).reshape(-1, 4) for i in (0, 1)])
    image_idx = np.repeat([0, 1], [12, 12])
    return Scene.from_images(
        Cameras(np.array([1, 2]), models, params, np.array([640, 640]), np.array([480, 480])),
        names,
        [0, 1],
        poses,
        points=Points.at(xyz),
        point_observations=PointObservations(image_idx, np.tile(np.arange(12), 2), pixels, np.tile(np.arange(12), 2)),
        lines=Lines.through(segments),
        line_observations=LineObservations(np.repeat([0, 1], 4), np.tile(np.arange(4), 2), ends),
        planes=Planes(np.array([1]), np.array([[0.0, 0.0, 1.0, -0.25]])),
        relations=Relations(
            point_on_plane=np.stack([np.arange(5), np.zeros(5, int)], axis=1), line_on_plane=np.array([[0, 0]])
        ),
    )


def localized_photograph() -> StoredImage:
    """As `groma localize` puts it into a table."""
    none, pose = np.zeros(0, int), se3.identity(1)[0]
    return StoredImage(
        "street/0001.jpg", "localized", "A sentence about it.", pose, 0.01 * np.eye(6), "PINHOLE", np.ones(4),
        np.ones(2, int), none, np.zeros((0, 2)), none, np.zeros((0, 4)), 0.0,
    )  # fmt: skip


def random_covariances() -> LandmarkCovariances:
    """Of the exact scene, different in every direction, so that a wrong axis shows."""
    rng = np.random.default_rng(5)

    def random(count: int, size: int) -> np.ndarray:
        root = 0.01 * rng.normal(size=(count, size, size))
        return root @ root.transpose(0, 2, 1)

    return LandmarkCovariances("inner", random(12, 3), random(4, 6), random(1, 4), random(2, 3))
