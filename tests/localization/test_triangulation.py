# SPDX-License-Identifier: BSD-3-Clause
"""Points of the features of a map: where they are, and that what else was measured of the map does not matter."""

import numpy as np
import pytest

from groma.localization.features import DescribedPoints
from groma.localization.triangulation import triangulate_features
from groma.scene.measurements import PosePriors
from groma.scene.survey import CameraPositions, ControlPoints, Marks
from groma.scene.synthetic import holistic

pytestmark = pytest.mark.kernels


def _triangulated(scene, seen):
    rng = np.random.default_rng(0)
    vectors = rng.integers(0, 255, (scene.num_points, 128), dtype=np.uint8)
    features = []
    for image in range(scene.num_images):
        rows = seen.image_idx == image
        count = int(rows.sum())
        features.append(
            DescribedPoints(seen.pixel[rows], np.ones(count), vectors[seen.point_idx[rows]], np.zeros(count, bool))
        )
    pairs = np.stack(np.triu_indices(scene.num_images, 1), axis=1)
    return triangulate_features(scene, features, pairs, lambda done, total: None)


def test_measurements_of_the_map_leave_its_points_alone():
    """Given poses, measured positions and control points have factors that are not of points."""
    truth = holistic(6, seed=1, noise_px=0.0).truth
    seen = truth.point_observations
    found = _triangulated(truth, seen)
    assert len(found.xyz) > 50
    gaps = np.linalg.norm(found.xyz[:, None] - truth.points.xyz[None], axis=2).min(axis=1)
    assert gaps.max() < 1e-6
    rows = np.flatnonzero(seen.point_idx == np.argmax(np.bincount(seen.point_idx)))
    one, count = truth.points.xyz[seen.point_idx[rows[:1]]], len(rows)
    measured = truth.replace(
        pose_priors=PosePriors(np.arange(6), truth.frames.rig_from_world, np.full((6, 6), 0.01)),
        camera_positions=CameraPositions(
            np.arange(6), truth.cam_centers_in_world, np.tile(0.01 * np.eye(3), (6, 1, 1)), np.zeros(6, bool)
        ),
        control_points=ControlPoints(("nail",), one, one, 1e-4 * np.eye(3)[None], np.ones(1, int)),
        marks=Marks(
            seen.image_idx[rows], np.zeros(count, int), seen.pixel[rows], np.ones(count), np.zeros(count, bool)
        ),
    )
    again = _triangulated(measured, seen)
    np.testing.assert_allclose(again.xyz, found.xyz, atol=1e-9)
