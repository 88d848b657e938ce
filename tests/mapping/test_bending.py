# SPDX-License-Identifier: BSD-3-Clause
"""Covers planes that bend: walls that are flat, rough or bent a little stay planes, pieces of columns are none."""

from dataclasses import replace

import numpy as np
import pytest

from groma.estimators.plane_search import PlaneSet
from groma.mapping.noise.landmarks import LineNoise, PointNoise
from groma.mapping.structure.bending import BendingGates, bending
from groma.mapping.structure.relations import Landmarks, Pairs, spacings
from groma.scene import LineIntervals

SIGMA, LEVEL, PIXEL = 0.002, 0.99, 0.01


def members(height, places, deviation=0.0, turn=None):
    """Landmarks at these heights over z = 0, plus noise, all of them on the plane z = 0 with this deviation, pixels."""
    points = np.column_stack([places, height + SIGMA * np.random.default_rng(5).standard_normal(len(places))])
    plane = np.array([0.0, 0.0, 1.0, -points[:, 2].mean()])
    if turn is not None:
        points = points @ turn.T
        plane[:3] = turn @ plane[:3]
    num, none = len(points), np.zeros((0, 2, 3))
    lines = LineNoise(none, np.zeros((0, 4, 4)), np.zeros(0), 0.1)
    noise = PointNoise(np.broadcast_to(SIGMA**2 * np.eye(3), (num, 3, 3)).copy(), np.ones(num), 0.1)
    marks = Landmarks(
        points, noise, np.ones(num, bool), none, lines, lines, np.zeros(0, bool), *spacings(points, none),
        LineIntervals(), np.full(num, PIXEL), np.zeros(0),
    )  # fmt: skip
    planes = PlaneSet(
        plane[None], 1e-8 * np.eye(4)[None], np.array([num]), np.ones(1), np.full(1, 4 * SIGMA), np.full(1, -9.0),
        np.zeros(num, int), np.zeros(0, int), [points],
    )  # fmt: skip
    on = Pairs(np.column_stack([np.arange(num), np.zeros(num, int)]), np.ones(num), np.full(num, deviation))
    return marks, planes, on, Pairs.empty()


def places(num=200, half=(1.0, 0.6), seed=3):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (num, 2)) * half


@pytest.mark.parametrize("turned_deg, expected", [(1.0, False), (4.0, True)])
def test_a_column_bends_and_a_slightly_bent_wall_does_not(turned_deg, expected):
    # A quarter of a cylinder's piece of width 2 b is turned by kappa b / 2 against the whole.
    at = places()
    height = -0.5 * np.deg2rad(turned_deg) * 2.0 / 0.6 * at[:, 1] ** 2
    found = members(height, at, float(np.std(height)) / PIXEL)
    assert bending(*found, LEVEL).tolist() == [expected]


def test_where_the_world_lies_is_no_matter():
    at = places()
    turn, _ = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))
    for degrees in (1.0, 4.0):
        height = -0.5 * np.deg2rad(degrees) * 2.0 / 0.6 * at[:, 1] ** 2
        found = [members(height, at, float(np.std(height)) / PIXEL, turn=one) for one in (None, turn)]
        assert bending(*found[0], LEVEL) == bending(*found[1], LEVEL)


def test_a_rough_wall_does_not_bend():
    """Of a hundred one fails the test by chance; more than five do in one of two thousand times."""
    at, rng = [places(seed=seed) for seed in range(100)], np.random.default_rng(2)
    bent = [bending(*members(0.05 * rng.standard_normal(200), one, 5.0), LEVEL)[0] for one in at]
    assert sum(bent) <= 5


def test_a_wall_of_panels_does_not_bend():
    at = places(400)
    steps = 0.02 * np.random.default_rng(2).standard_normal((8, 6))
    height = steps[np.digitize(at[:, 0], np.linspace(-0.8, 0.8, 7)), np.digitize(at[:, 1], np.linspace(-0.4, 0.4, 5))]
    assert not bending(*members(height, at, 2.0), LEVEL).any()


def test_tilts_of_lines_on_a_narrow_face_do_not_bend_it():
    """Edges, each end five deviations off, one above the face, the other below: heavy tails, not a bend."""
    marks, planes, points, _ = members(np.zeros(60), places(60, (1.0, 0.03)))
    rng, num = np.random.default_rng(1), 12
    side = rng.choice([-1.0, 1.0], num)
    start = np.column_stack([rng.uniform(-0.9, -0.1, num), 0.03 * side, 5.0 * SIGMA * side])
    segments = np.stack([start, start * [-1.0, 1.0, -1.0]], axis=1)
    across = np.broadcast_to(np.eye(3)[1:], (num, 2, 3))
    noise = LineNoise(across, np.broadcast_to(SIGMA**2 * np.eye(4), (num, 4, 4)), np.ones(num), 0.1)
    marks = replace(marks, segments=segments, line_noise=noise, line_usable=np.ones(num, bool))
    marks = replace(marks, line_pixel=np.full(num, PIXEL))
    lines = Pairs(np.column_stack([np.arange(num), np.zeros(num, int)]), np.ones(num), np.zeros(num))
    assert not bending(marks, planes, points, lines, LEVEL).any()


def test_few_members_tell_nothing():
    at = places(4 * BendingGates().members - 1)
    assert not bending(*members(10.0 * at[:, 0] ** 2, at), LEVEL).any()


@pytest.mark.parametrize("at", [places() * [1.0, 0.0], np.zeros((100, 2))])
def test_members_in_a_row_or_at_one_place_tell_nothing(at):
    assert not bending(*members(np.zeros(len(at)), at), LEVEL).any()


def test_no_planes_and_a_plane_without_members():
    marks, planes, _, lines = members(np.zeros(50), places(50))
    assert not bending(marks, planes, Pairs.empty(), lines, LEVEL).any()
    nothing, no_number, labels = np.zeros(0), np.zeros(0, int), (np.full(50, -1), np.zeros(0, int))
    none = PlaneSet(np.zeros((0, 4)), np.zeros((0, 4, 4)), no_number, nothing, nothing, nothing, *labels)
    assert len(bending(marks, none, Pairs.empty(), lines, LEVEL)) == 0
