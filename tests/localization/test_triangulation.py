# SPDX-License-Identifier: BSD-3-Clause
"""Points of a map from matched features: where they are, whatever else was measured of the map."""

import itertools

import numpy as np
import pytest

from groma.localization.features import DescribedPoints
from groma.localization.triangulation import triangulate_features
from groma.scene import CameraPositions, Distances
from groma.scene.survey import Kind, diagonal_covariance
from groma.scene.synthetic.scenes import holistic

pytestmark = pytest.mark.kernels


def test_measurements_of_a_map_do_not_matter():
    truth = holistic(6, noise_px=0.5, seed=0).truth
    seen = truth.point_observations
    descriptors = np.random.default_rng(0).integers(0, 256, (len(truth.points), 128), np.uint8)
    features = []
    for image in range(len(truth.images)):
        row = np.flatnonzero(seen.image_idx == image)
        point, upright = seen.point_idx[row], np.zeros(len(row), bool)
        features.append(DescribedPoints(seen.pixel[row], np.full(len(row), 0.5), descriptors[point], upright))
    pairs = np.array(list(itertools.combinations(range(len(features)), 2)))
    centers = truth.cam_centers_in_world
    measured = truth.replace(
        camera_positions=CameraPositions(np.arange(6), centers + 0.1, diagonal_covariance(np.full((6, 3), 0.1))),
        distances=Distances.between(Kind.IMAGE, [0], [1], [1.0], [0.1]),
    )
    found, again = (triangulate_features(scene, features, pairs, lambda done, of: None) for scene in (truth, measured))
    assert len(found.xyz) > 20
    assert np.array_equal(found.xyz, again.xyz) and np.array_equal(found.covariance, again.covariance)
