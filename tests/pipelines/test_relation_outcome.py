# SPDX-License-Identifier: BSD-3-Clause
"""Wrong associations lose: they are given up, counted and dropped, and poses are not worse than without relations."""

import numpy as np
import pytest

import groma
from groma.evaluation import evaluate_poses
from groma.scene import Relations, synthetic

pytestmark = pytest.mark.kernels


@pytest.fixture(scope="module")
def scenes():
    """A scene, and the same with every eighth point tied to a wrong plane."""
    scene = synthetic.holistic(24, noise_px=0.5, seed=5)
    right = scene.start.relations.point_on_plane
    wrong = right.copy()
    rows = np.arange(0, len(right), 8)
    wrong[rows, 1] = (wrong[rows, 1] + 1 + np.arange(len(rows)) % (scene.start.num_planes - 1)) % scene.start.num_planes
    hesse = scene.truth.planes.hesse[wrong[rows, 1]]
    places = scene.truth.points.xyz[wrong[rows, 0]]
    assert np.median(np.abs(np.einsum("ni,ni->n", places, hesse[:, :3]) + hesse[:, 3])) > 0.5  # they are wrong by far
    relations = Relations(point_on_plane=wrong, line_on_plane=scene.start.relations.line_on_plane)
    return scene, scene.start.replace(relations=relations), rows


def test_wrong_relations_are_dropped_and_counted(scenes):
    _, tied, rows = scenes
    result = groma.adjust(tied)
    outcome = result.report.relations["point_on_plane"]
    assert outcome["held"] + outcome["dropped"] == len(tied.relations.point_on_plane)
    kept = {tuple(pair) for pair in result.scene.relations.point_on_plane.tolist()}
    assert len(kept) == outcome["held"] == len(result.scene.relations.point_on_plane)
    wrong = {tuple(pair) for pair in tied.relations.point_on_plane[rows].tolist()}
    right = {tuple(pair) for pair in np.delete(tied.relations.point_on_plane, rows, axis=0).tolist()}
    assert len(wrong & kept) < 0.1 * len(wrong)
    assert len(right - kept) < 0.02 * len(right)
    assert result.report.to_dict()["relations"]["point_on_plane"] == outcome


def test_poses_are_not_worse_than_without_relations(scenes):
    scene, tied, _ = scenes
    without = groma.adjust(tied.replace(relations=Relations()), groma.AdjustOptions(planes=False))
    errors = [evaluate_poses(result.scene, scene.truth).center_rmse for result in (groma.adjust(tied), without)]
    assert errors[0] < 1.02 * errors[1]


def test_plain_least_squares_drops_nothing(scenes):
    _, tied, _ = scenes
    result = groma.adjust(tied, groma.AdjustOptions(loss="none"))
    assert result.report.relations["point_on_plane"]["dropped"] == 0
    assert len(result.scene.relations) == len(tied.relations)
