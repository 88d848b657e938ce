# SPDX-License-Identifier: BSD-3-Clause
"""Wrong associations lose: they are given up, counted and dropped, and poses are not worse than without relations."""

import numpy as np
import pytest

import groma
from groma.evaluation import evaluate_poses
from groma.scene import Relations, synthetic


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


def _real_like():
    """A walk with the noise of matches: a narrow core, one point match in twenty wrong, and an eighth of ties wrong."""
    scene = synthetic.corridor(24, noise_px=0.3, seed=4)
    rng = np.random.default_rng(0)
    table = scene.start.point_observations
    pixel = table.pixel.copy()
    wrong = rng.random(len(pixel)) < 0.05
    pixel[wrong] += rng.uniform(-30.0, 30.0, (int(wrong.sum()), 2))
    right = scene.start.relations
    tied = {}
    for name in ("point_on_plane", "line_on_plane"):
        pairs = getattr(right, name).copy()
        rows = np.flatnonzero(rng.random(len(pairs)) < 0.125)
        pairs[rows, 1] = (pairs[rows, 1] + rng.integers(1, scene.start.num_planes, len(rows))) % scene.start.num_planes
        tied[name] = pairs
    start = scene.start.replace(point_observations=table.replace(pixel=pixel), relations=Relations(**tied))
    return scene.truth, start


def test_wrong_ties_beside_wrong_matches_are_never_worse_than_points_alone():
    truth, start = _real_like()
    assert len(start.relations.point_on_plane) > 100
    errors = {}
    for name, scene, options in (
        ("points", start.replace(relations=Relations()), groma.AdjustOptions(lines=False, planes=False)),
        ("everything", start, groma.AdjustOptions()),
    ):
        result = groma.adjust(scene, options)
        errors[name] = evaluate_poses(result.scene, truth)
    assert result.report.relations["point_on_plane"]["dropped"] > 0.8 * 0.125 * len(start.relations.point_on_plane)
    assert errors["everything"].center_rmse <= errors["points"].center_rmse
    assert errors["everything"].rotation_deg_mean <= errors["points"].rotation_deg_mean
