# SPDX-License-Identifier: BSD-3-Clause
"""Covers the place of edges that have another one beside them, on pictures of steps that are exact in every pixel.

Also: edges that converge, edges alone, soft edges, edges along the rows, at the border, and segments without a fit.
"""

import numpy as np
import pytest
from _renderings import segment_on, steps, to_uint8

from groma.features import LsdDetector
from groma.features.close_edges import CloseEdges, placed
from groma.features.edge_fit import measure_edges

pytestmark = pytest.mark.kernels

NOISE = 2.0


def _errors(distance, ratio, blur, count, *, turn=0.0, length=50.0, angles=None, seed=0):
    """Offset and tilt of segments from their edge, as fitted in the smoothed image and as separated, and deviations."""
    rng = np.random.default_rng(seed)
    rows = []
    for k in range(count):
        angle = rng.uniform(0.0, 2.0 * np.pi) if angles is None else angles[k % len(angles)]
        at, side = rng.uniform(-1.0, 1.0), rng.choice([-1.0, 1.0])
        exact = steps(angle, [at, at + side * distance], [80.0, 80.0 * ratio], 90.0 - 40.0 * ratio, blur, turn=turn)
        image = to_uint8(exact, rng, NOISE)
        start = segment_on(angle, at + rng.normal(0.0, 0.2), length)
        across = np.array([-np.sin(angle), np.cos(angle)])
        row = []
        fitted = measure_edges(image, start)[:2]
        for ends, sigma in (fitted, placed(image, *fitted)):
            away = side * ((ends.reshape(2, 2) - 48.0) @ across - at)
            row += [away.mean(), away[1] - away[0], sigma[0]]
        rows.append(row)
    return np.array(rows).T


@pytest.mark.parametrize("ratio", [-1.0, -0.5])
@pytest.mark.parametrize("blur", [0.5, 0.8])
def test_a_neighbour_of_the_other_sign_does_not_displace_an_edge(ratio, blur):
    smooth, _, _, place, _, _ = _errors(3.0, ratio, blur, 8)
    assert abs(smooth.mean()) > 0.15
    # The prior on the displacement leaves a twentieth of it.
    assert abs(place.mean()) < 0.05
    assert np.abs(place).max() < 0.1


@pytest.mark.parametrize("distance", [1.5, 2.0])
def test_what_cannot_be_told_apart_is_uncertain(distance):
    smooth, _, before, place, _, sigma = _errors(distance, -1.0, 0.6, 8)
    assert np.abs(place).max() < 0.6 * np.abs(smooth).min()
    assert (sigma > before).all()
    # Mean squares of eight normal errors exceed this once in ten million; the smoothed fit is off by 8 and more.
    assert np.sqrt(((place / sigma) ** 2).mean()) < 2.5
    assert np.sqrt(((smooth / before) ** 2).mean()) > 7.0


def test_two_rises_of_a_stair_are_told_apart():
    smooth, _, _, place, _, _ = _errors(3.0, 0.5, 0.6, 8)
    assert smooth.mean() > 0.2
    assert np.abs(place).max() < 0.1


def test_edges_that_converge_do_not_turn_each_other():
    _, turned, _, place, tilt, _ = _errors(2.0, -1.0, 0.6, 8, turn=0.02)
    assert np.abs(turned).min() > 0.2
    assert np.abs(tilt).max() < 0.5 * np.abs(turned).min()
    assert np.abs(place).max() < 0.15


@pytest.mark.parametrize("blur", [0.4, 0.8, 2.5])
def test_an_edge_alone_stays_where_it_is(blur):
    """Whatever its blur: a soft edge is no pair of sharp ones, and noise of a step's place moves none."""
    smooth, turned, before, place, tilt, sigma = _errors(40.0, 0.0, blur, 12)
    np.testing.assert_array_equal(sigma, before)
    np.testing.assert_array_equal(place, smooth)
    np.testing.assert_array_equal(tilt, turned)


def test_edges_along_rows_and_columns():
    angles = 0.5 * np.pi * np.arange(4)
    smooth, _, _, place, _, _ = _errors(3.0, -1.0, 0.6, 8, angles=angles)
    assert np.abs(place).max() < 0.15 < np.abs(smooth).min()


def test_segments_without_a_fit_and_at_the_border():
    image = to_uint8(steps(0.3, [0.0, 2.0], [80.0, -80.0], 60.0, 0.6))
    ends = np.vstack([segment_on(0.3, 0.1, 40.0), segment_on(0.3, 0.1, 40.0), [[0.2, 0.0, 0.4, 60.0]]])
    new, sigma = placed(image, ends, np.array([0.5, 0.05, 0.05]))
    np.testing.assert_array_equal(new[[0, 2]], ends[[0, 2]])
    assert sigma[0] == 0.5
    assert not np.array_equal(new[1], ends[1])
    assert np.isfinite(new).all() and (sigma >= [0.5, 0.05, 0.05]).all()
    assert placed(image, np.zeros((0, 4)), np.zeros(0))[0].shape == (0, 4)


@pytest.mark.parametrize("shape", [(1, 1), (3, 40), (40, 3)])
def test_tiny_images(shape):
    image = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
    ends = np.array([[0.0, 0.5, 1.0, 0.5], [0.5, 1.5, 39.0, 1.6], [1.5, 39.0, 1.4, 0.5], [1.0, 1.0, 1.0, 1.0]])
    new, sigma = placed(image, ends, np.full(4, 0.1))
    assert np.isfinite(new).all() and np.isfinite(sigma).all()


def test_a_detector_with_places_in_the_image_as_it_is():
    image = to_uint8(steps(0.3, [0.0, 3.0], [80.0, -80.0], 60.0, 0.6), np.random.default_rng(2), NOISE)
    detector = LsdDetector()
    before, after = detector.detect(image), CloseEdges(detector).detect(image)
    assert len(before) == len(after) == 2
    across = np.array([-np.sin(0.3), np.cos(0.3)])
    for found, low, high in ((before, 0.15, 0.5), (after, 0.0, 0.1)):
        away = np.sort((found.midpoint - 48.0) @ across) - [0.0, 3.0]
        assert (np.abs(away) >= low).all() and (np.abs(away) < high).all()
    assert len(CloseEdges(detector).detect(np.zeros((40, 40), np.uint8))) == 0
