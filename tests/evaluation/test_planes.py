# SPDX-License-Identifier: BSD-3-Clause
"""Plane scores: matching, angles and offsets known by hand, points, degenerate cases, the command."""

import json

import numpy as np
import pytest

from groma.cli.main import run
from groma.errors import InputError, ShapeError
from groma.evaluation import evaluate_planes, match_planes, score_planes, score_planes_by_points
from groma.evaluation.planes import plane_places
from groma.io import write_scene
from groma.scene import Lines, Planes, Points, Relations, Scene
from groma.scene.synthetic.scenes import holistic

FLOOR, WALL = [0, 0, 1, -1.0], [1, 0, 0, 2.0]


def test_equal_planes_match_whatever_their_sign_and_scale():
    pairs, angle, offset = match_planes([[-2, 0, 0, -4], FLOOR], [FLOOR, WALL], [[5, 5, 1], [-2, 3, 3]])
    assert pairs.tolist() == [[0, 1], [1, 0]]
    assert angle.tolist() == offset.tolist() == [0, 0]


def test_known_angle_and_offset():
    """A floor tilted by 3 degrees about the y axis through (0, 0, 1), seen at (10, 0, 1): 10 sin 3 deg away."""
    for degrees in (3.0, 1e-7):
        tilt = np.deg2rad(degrees)
        plane = [np.sin(tilt), 0, np.cos(tilt), -np.cos(tilt)]
        scores = score_planes([plane], [FLOOR], [[10, 0, 1]])
        assert scores.normal_deg_mean == pytest.approx(degrees, rel=1e-6)
        assert scores.offset_max == pytest.approx(10 * np.sin(tilt), rel=1e-6)
        assert (scores.precision, scores.recall) == (1, 1)


def test_limits():
    parallel = [0, 0, 1, -1.2]
    assert score_planes([parallel], [FLOOR], [[0, 0, 1]], max_offset=0.25).recall == 1
    scores = score_planes([parallel, WALL], [FLOOR], [[0, 0, 1]], max_offset=0.15)
    assert (scores.precision, scores.recall, len(scores.matches)) == (0, 0, 0)
    assert np.isnan(scores.normal_deg_mean)
    assert np.isnan(scores.offset_max)


def test_as_many_matches_as_possible_then_the_closest():
    # Plane 0 fits both references, plane 1 only the first: both are matched although 0 is closer to the first.
    estimate = [[0, 0, 1, -1.0], [0, 0, 1, -0.7]]
    reference = [[0, 0, 1, -1.0], [0, 0, 1, -1.3]]
    pairs, _, offset = match_planes(estimate, reference, [[0, 0, 1.0], [0, 0, 1.3]], max_offset=0.35)
    assert pairs.tolist() == [[0, 1], [1, 0]]
    np.testing.assert_allclose(offset, [0.3, 0.3])
    twice, _, _ = match_planes([FLOOR, [0, 0, 1, -1.1]], [FLOOR], [[0, 0, 1.0]])
    assert twice.tolist() == [[0, 0]]


def test_places_are_where_a_plane_was_seen():
    scene = Scene(
        points=Points.at([[0, 0, 1.2], [4, 0, 0.8], [50, 50, 50]]),
        lines=Lines.through([[[2, 3, 1], [2, 9, 1]]]),
        planes=Planes([1, 2], [FLOOR, WALL]),
        relations=Relations(point_on_plane=[[0, 0], [1, 0]], line_on_plane=[[0, 0]]),
    )
    middle = np.array([[0, 0, 1.2], [4, 0, 0.8], [50, 50, 50], [2, 6, 1]]).mean(0)
    np.testing.assert_allclose(plane_places(scene), [[2, 2, 1], [-2, middle[1], middle[2]]])


def test_scenes():
    made = holistic(20, seed=4)
    exact = evaluate_planes(made.truth, made.truth)
    assert (exact.precision, exact.recall, exact.normal_deg_max, exact.offset_max) == (1, 1, 0, 0)
    assert exact.matches.tolist() == [[k, k] for k in range(made.truth.num_planes)]
    start = evaluate_planes(made.start, made.truth, max_offset=1.0)
    assert start.normal_deg_mean > 0.1
    assert start.offset_mean > 0.01
    empty = evaluate_planes(made.truth.points_only(), made.truth)
    assert empty.recall == 0
    assert np.isnan(empty.precision)
    with pytest.raises(InputError, match="no planes"):
        evaluate_planes(made.truth, made.truth.points_only())
    with pytest.raises(InputError, match="no extent"):
        evaluate_planes(made.truth, Scene(planes=made.truth.planes))


def test_points():
    places = [[0, 0, 1.0], [3, 3, 1.02], [7, 7, 0.9], [-2.01, 5, 9]]
    scores = score_planes_by_points([FLOOR, WALL], places, [0.015, 0.03, 0.2])
    assert list(scores.inlier_share.values()) == [0.5, 0.75, 1]
    assert scores.inlier_rmse[0.03] == pytest.approx(np.sqrt((0.02**2 + 0.01**2) / 3))
    none = score_planes_by_points(np.zeros((0, 4)), places, [0.1])
    assert none.inlier_share == {0.1: 0}
    assert np.isnan(none.inlier_rmse[0.1])


def test_refusals():
    with pytest.raises(InputError, match="without a normal"):
        match_planes([[0, 0, 0, 1]], [FLOOR], [[0, 0, 1]])
    with pytest.raises(ShapeError, match="places"):
        match_planes([FLOOR], [FLOOR], np.zeros((2, 3)))
    with pytest.raises(ShapeError, match="estimate"):
        match_planes([FLOOR[:3]], [FLOOR], [[0, 0, 1]])
    with pytest.raises(InputError, match="positive"):
        match_planes([FLOOR], [FLOOR], [[0, 0, 1]], max_offset=0)
    with pytest.raises(InputError, match="no points"):
        score_planes_by_points([FLOOR], np.zeros((0, 3)))


def test_command(tmp_path, capsys):
    made = holistic(10, seed=2)
    write_scene(made.start, tmp_path / "start.npz")
    write_scene(made.truth, tmp_path / "truth.npz")
    np.save(tmp_path / "points.npy", made.truth.points.xyz)
    for reference, key in (("truth.npz", "recall"), ("points.npy", "inlier_share")):
        arguments = ["evaluate", "planes", str(tmp_path / "start.npz"), str(tmp_path / reference)]
        assert run([*arguments, "--json", "-"]) == 0
        assert key in json.loads(capsys.readouterr().out)
