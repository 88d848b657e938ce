# SPDX-License-Identifier: BSD-3-Clause
"""Loops of the plane search against plain computations: nearest points, parts that are connected, tilt, projection."""

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from groma.estimators._plane_candidates import features_of, keep_others_loop
from groma.estimators._plane_growth import tilt_loop
from groma.estimators._plane_loops import connected_loop, connected_part_loop, fit_loop
from groma.estimators.plane_fit import fit_plane, tilt_sigma
from groma.geometry.algebra import perpendicular

pytestmark = pytest.mark.kernels


def features_at(places, segments=0):
    """Features with noise of one millimetre, the last ones ends of segments; every third point is carried by one."""
    number = len(places)
    partner, carrier = np.arange(number), np.full(number, -1)
    first = number - 2 * segments
    partner[first:] = first + (np.arange(2 * segments) ^ 1)
    if segments:
        carrier[:first:3] = first + 2 * (np.arange(len(carrier[:first:3])) % segments)
    return features_of(places, np.broadcast_to(1e-6 * np.eye(3), (number, 3, 3)), partner, carrier)


def linking(features):
    """What says which features are linked."""
    return features.places, features.spacing, features.partner, features.carrier, features.neighbours


@pytest.mark.parametrize("seed", range(6))
def test_connected_part_is_that_of_a_graph(seed):
    """Some of the features take part, so that most of the neighbours of many do not."""
    rng = np.random.default_rng(seed)
    clumps = rng.uniform(0, 6, (8, 3))[rng.integers(0, 8, 200)]
    features = features_at(clumps + rng.normal(0, 0.3, (200, 3)), segments=20)
    rows = np.flatnonzero(rng.random(200) < (0.2, 0.5, 0.9)[seed % 3])
    held = np.flatnonzero(rng.random(200) < 0.2)
    rank, reach = 4, 0.7
    distance, nearest = KDTree(features.places[rows]).query(features.places[rows], k=rank + 1)
    first = np.repeat(np.arange(len(rows)), rank + 1)
    second = nearest.ravel()
    near = distance.ravel() <= reach * np.maximum(features.spacing[rows[first]], features.spacing[rows[second]])
    place = np.full(200, -1)
    place[rows] = np.arange(len(rows))
    other = place[features.partner[rows]]
    first = np.concatenate([first[near], np.flatnonzero(other >= 0)])
    second = np.concatenate([second[near], other[other >= 0]])
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(len(rows), len(rows)))
    label = connected_components(graph, directed=False)[1]
    expected = rows[label == np.argmax(np.bincount(label, weights=np.isin(rows, held)))]
    carrier = features.carrier[expected]
    mark, part = np.full(200, -1), np.empty(200, np.int64)
    count, independent = connected_part_loop(*linking(features), rows, held, rank, reach, mark, part)
    assert 1 < len(np.unique(label)) and part[:count].tolist() == expected.tolist()
    assert independent == count - np.isin(carrier[carrier >= 0], expected).sum()
    assert (mark == -1).all()


def test_links_are_as_long_as_is_allowed():
    """Of a row of features those in the middle have their eighth neighbour 4 away: every twelfth is linked by three."""
    features = features_at(np.linspace(0, 120, 121)[:, None] * [1.0, 0.0, 0.0])
    rows = features.position[24:97:12].copy()
    mark, part = np.full(121, -1), np.empty(121, np.int64)
    assert (features.spacing[rows] == 4.0).all()
    assert connected_part_loop(*linking(features), rows, rows[:1], 8, 3.0, mark, part)[0] == len(rows)
    assert connected_part_loop(*linking(features), rows, rows[:1], 8, 2.99, mark, part)[0] == 1


def test_nothing_is_connected_where_nothing_is_held():
    features = features_at(np.random.default_rng(0).normal(size=(50, 3)))
    mark, part, none = np.full(50, -1), np.empty(50, np.int64), np.zeros(0, np.int64)
    assert connected_part_loop(*linking(features), np.arange(30), none, 8, 3.0, mark, part) == (0, 0)
    assert connected_part_loop(*linking(features), np.arange(2), np.arange(2), 8, 3.0, mark, part) == (2, 0)


def test_tilt_is_that_of_the_covariance_of_the_fit():
    """Up to the 1e-12 that the fit adds to correlations, which the narrow ones make 1e-6 at most."""
    rng = np.random.default_rng(5)
    for narrow in (1.0, 0.1, 1e-3):
        basis = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        features = features_at(rng.normal(size=(60, 3)) * [1.0, narrow, 1e-4] @ basis)
        rows, weight = np.arange(60), rng.uniform(0.1, 1.0, 60)
        plane, center, precision = np.empty(4), np.empty(3), np.empty(60)
        fit_loop(features.places, features.packed, rows, weight, 10, plane, center, precision)
        fit = fit_plane(features.places, np.broadcast_to(1e-6 * np.eye(3), (60, 3, 3)), weight)
        expected = float(tilt_sigma(fit.covariance))
        none = np.zeros_like(features.packed)
        tilt = tilt_loop(features.places, none, rows, plane, center, precision)
        assert np.sqrt(tilt) == pytest.approx(expected, rel=1e-6)
    on_line = features_at(np.outer(np.linspace(0, 1, 20), [1.0, 2.0, 0.5]))
    rows, plane, center = np.arange(20), np.empty(4), np.empty(3)
    fit_loop(on_line.places, on_line.packed, rows, np.ones(20), 10, plane, center, precision)
    assert tilt_loop(on_line.places, on_line.packed, rows, plane, center, precision) > 1.0


def test_noise_across_a_line_does_not_tell_a_normal():
    """Known well in one direction and badly in another, points of a line are spread as if they lay on a plane."""
    rng, deviation = np.random.default_rng(7), np.array([1e-3, 0.1, 1e-3])
    rows, plane, center, precision = np.arange(200), np.empty(4), np.empty(3), np.empty(200)
    for wide, told in ((0.0, False), (0.3, True)):
        places = np.outer(rng.uniform(0, 3, 200), [1.0, 0, 0]) + wide * rng.uniform(-1, 1, (200, 1)) * [0, 1.0, 0]
        features = features_at(places + deviation * rng.normal(size=(200, 3)))
        packed = np.tile([deviation[0] ** 2, 0, 0, deviation[1] ** 2, 0, deviation[2] ** 2], (200, 1))
        fit_loop(features.places, packed, rows, np.ones(200), 10, plane, center, precision)
        tilt = np.sqrt(tilt_loop(features.places, packed, rows, plane, center, precision))
        assert (tilt < 0.002) == told and (tilt > 0.005 or told)


def test_connected_is_what_is_near_in_the_projection():
    rng = np.random.default_rng(6)
    plane = np.append(np.array([2.0, -1.0, 2.0]) / 3.0, 0.4)
    support, tested, reach = rng.normal(size=(80, 3)), rng.normal(size=(300, 3)), rng.uniform(0.01, 0.5, 300)
    basis = np.stack(perpendicular(plane[:3]), axis=1)
    rows, which, connected = np.arange(0, 80, 2), rng.permutation(300)[:200], np.zeros(200, bool)
    distance = KDTree(support[rows] @ basis).query(tested[which] @ basis)[0]
    connected_loop(support, rows, tested, which, reach, 1.5, plane, connected)
    assert 50 < connected.sum() < 150
    assert (connected == (distance <= 1.5 * reach[which])).all()
    connected_loop(support, rows[:0], tested, which, reach, 1.5, plane, connected)
    assert not connected.any()


@pytest.mark.parametrize("number", [1, 2, 7, 8])
def test_candidates_near_a_plane_are_dropped_by_the_median_of_their_distances(number):
    """Also where as many features are within the limit as beyond it, so that the two in the middle tell."""
    rng = np.random.default_rng(number)
    features = features_at(rng.normal(size=(number, 3)))
    planes = np.column_stack([np.tile([0.0, 0.0, 1.0], (400, 1)), rng.uniform(-2.0, 2.0, 400)])
    alive, mark = rng.random(400) < 0.9, np.full(number, -1)
    limit = 800.0 * 1e-3  # in standard deviations of the features
    away = np.median(np.abs(features.places[:, 2] + planes[:, 3:]), axis=1)
    expected = alive & (away > limit)
    first_at = np.append(0, np.full(number, 400))  # all candidates are at home at the first feature
    keep_others_loop(
        features.arrays, np.arange(number), planes[0], planes, 800.0, first_at, np.arange(400), mark, alive
    )
    assert (alive == expected).all() and 0 < alive.sum() < 360
    assert (mark == -1).all()
