# SPDX-License-Identifier: BSD-3-Clause
"""Directions shared by normals and by lines: found, refined, certain as claimed; nothing in noise; orthogonality."""

from dataclasses import replace

import numpy as np
import pytest

from groma.errors import InputError, ShapeError
from groma.estimators.directions import (
    DirectionOptions,
    directions_from_lines,
    directions_from_normals,
    orthogonal_pairs,
)
from groma.geometry.so3 import exp

pytestmark = pytest.mark.kernels

FRAME = exp(np.array([0.3, -0.2, 0.5]))
EXACT = DirectionOptions(parallel_sigma=1e-5)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def noisy_normals(rng, directions, each, clutter, sigma):
    """Unit normals perpendicular to each direction, disturbed across by ``sigma``, and random ones."""
    normals, factors = [], []
    for direction in directions:
        exact = unit(np.cross(rng.normal(size=(each, 3)), direction))
        along = np.cross(exact, direction)
        normals.append(
            unit(exact + sigma * (rng.normal(size=(each, 1)) * direction + rng.normal(size=(each, 1)) * along))
        )
        factors.append(sigma * np.stack([np.broadcast_to(direction, along.shape), along], axis=-1))
    wild = unit(rng.normal(size=(clutter, 3)))
    first = unit(np.cross(wild, [0.1, 0.2, 1.0]))
    normals.append(wild)
    factors.append(sigma * np.stack([first, np.cross(wild, first)], axis=-1))
    return np.concatenate(normals), np.concatenate(factors)


def angles(found, true):
    return np.arccos(np.clip(np.abs(found @ true.T), 0, 1))


def test_vanishing_directions_among_clutter():
    rng = np.random.default_rng(1)
    normals, factors = noisy_normals(rng, FRAME, 60, 120, 2e-3)
    found = directions_from_normals(normals, factors, EXACT)
    assert len(found) == 3
    # 60 normals at 2 mrad fix a direction to about 0.4 mrad; five times that.
    assert angles(found.vectors, FRAME).min(axis=0).max() < 2e-3
    assert found.orthogonal.tolist() == [[0, 1], [0, 2], [1, 2]]
    owner = angles(found.vectors, FRAME).argmin(axis=1)
    for k in range(3):
        own = found.label[60 * owner[k] : 60 * owner[k] + 60]
        assert (own == k).mean() > 0.85  # 95 % within the gate, some nearer to another direction by chance
    assert (found.label[180:] >= 0).mean() < 0.1
    assert (found.support == np.bincount(found.label[found.label >= 0])).all()


def test_nothing_in_noise():
    rng = np.random.default_rng(2)
    normals, factors = noisy_normals(rng, FRAME[:0], 0, 400, 5e-3)
    assert len(directions_from_normals(normals, factors)) == 0
    lines = unit(rng.normal(size=(300, 3)))
    noise = (5e-3) ** 2 * np.broadcast_to(np.eye(3), (300, 3, 3))
    assert len(directions_from_lines(lines, noise)) == 0


def test_covariance_is_that_of_repeated_trials():
    """Mahalanobis distances of found directions follow chi-square with two degrees of freedom: mean 2."""
    squared = []
    for seed in range(60):
        rng = np.random.default_rng([3, seed])
        normals, factors = noisy_normals(rng, FRAME[:1], 40, 0, 3e-3)
        found = directions_from_normals(normals, factors, replace(EXACT, level=0.999))
        assert len(found) == 1
        basis = np.linalg.svd(FRAME[:1])[2][1:]
        error = basis @ found.vectors[0]
        squared.append(error @ np.linalg.solve(basis @ found.covariance[0] @ basis.T, error))
    # Standard deviation of the mean of 60: 2 / sqrt(60) = 0.26. Covariances are never made smaller, so low is likelier.
    assert 1.0 < np.mean(squared) < 2.9


def test_line_directions_with_elongated_noise():
    rng = np.random.default_rng(4)
    truth = np.repeat(FRAME[:2], 40, axis=0)
    across = unit(np.cross(truth, [0.3, 0.5, 0.9]))
    other = np.cross(truth, across)
    lines = unit(truth + 0.03 * rng.normal(size=(80, 1)) * across + 0.002 * rng.normal(size=(80, 1)) * other)
    lines *= rng.choice([-1, 1], (80, 1))
    noise = 0.03**2 * across[:, :, None] * across[:, None] + 0.002**2 * other[:, :, None] * other[:, None]
    found = directions_from_lines(lines, noise, EXACT)
    assert len(found) == 2
    # Forty lines at 2 mrad in the good direction; the common noise direction is worse: 30 / sqrt(40) = 5 mrad.
    assert angles(found.vectors, FRAME[:2]).min(axis=1).max() < 0.015
    assert (found.label >= 0).mean() > 0.9


def test_orthogonal_pairs_need_certainty():
    directions = np.array([[1, 0, 0], [0, 1, 0], [0, np.sin(0.1), np.cos(0.1)]])
    certain, vague = np.zeros((3, 3, 3)), np.broadcast_to(0.1**2 * np.eye(3), (3, 3, 3))
    assert orthogonal_pairs(directions, certain).tolist() == [[0, 1], [0, 2]]
    assert len(orthogonal_pairs(directions, vague)) == 0


@pytest.mark.parametrize("count", [0, 1, 4])
def test_too_few(count):
    found = directions_from_normals(np.eye(3)[np.arange(count) % 3], np.zeros((count, 3, 2)))
    assert len(found) == 0 and found.label.shape == (count,) and found.vectors.shape == (0, 3)
    assert len(directions_from_lines(np.eye(3)[np.arange(count) % 3], np.zeros((count, 3, 3)))) == 0


@pytest.mark.parametrize("count", [2, 3, 4])
def test_few_lines_that_are_all_parallel_are_one_direction(count):
    """None is left that is along nothing."""
    lines = np.tile(FRAME[0], (count, 1)) + np.random.default_rng(0).normal(0.0, 1e-6, (count, 3))
    options = DirectionOptions(min_coincidences=count - 1, max_false_alarms=1e6)
    found = directions_from_lines(
        lines, np.tile(1e-10 * np.eye(3), (count, 1, 1)), options, turned=np.full(count, 1e-3)
    )
    assert len(found) <= 1 and (count < 3 or (found.label == 0).all())


def test_bad_input():
    with pytest.raises(ShapeError, match="factors"):
        directions_from_normals(np.eye(3), np.zeros((2, 3, 2)))
    with pytest.raises(ShapeError, match="covariance"):
        directions_from_lines(np.eye(3), np.zeros((3, 2)))
    with pytest.raises(InputError, match="finite"):
        directions_from_lines(np.full((3, 3), np.nan), np.zeros((3, 3, 3)))


def lines_along(rng, directions, each, sigma):
    """Directions of lines, disturbed by ``sigma``, and their covariances."""
    found = unit(np.repeat(directions, each, axis=0) + sigma * rng.normal(size=(each * len(directions), 3)))
    return found, np.tile(sigma**2 * np.eye(3), (len(found), 1, 1))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_four_long_parallel_lines_are_enough(seed):
    """The four edges of a box along each of its sides, for six boxes: what one line determines, three confirm."""
    rng = np.random.default_rng(seed)
    true = unit(rng.normal(size=(18, 3)))
    directions, covariance = lines_along(rng, true, 4, 1e-3)
    found = directions_from_lines(directions, covariance)
    error = angles(found.vectors, true).min(axis=1)
    assert error.max() < 4e-3
    # The test at 95 % loses one of four lines of each fifth direction, and with it the direction.
    assert len(np.unique(angles(found.vectors, true).argmin(axis=1))) == len(found) >= 12
    three, covariance = lines_along(rng, true, 3, 1e-3)
    assert len(directions_from_lines(three, covariance)) == 0


@pytest.mark.parametrize(("count", "sigma"), [(60, 5e-3), (60, 3e-2), (300, 5e-3), (300, 2e-2)])
def test_no_direction_among_lines_without_one(count, sigma):
    rng = np.random.default_rng(7)
    for _ in range(10):
        directions = unit(rng.normal(size=(count, 3)))
        spread = sigma * np.exp(rng.normal(0.0, 0.7, count))
        assert len(directions_from_lines(directions, spread[:, None, None] ** 2 * np.eye(3))) == 0


@pytest.mark.parametrize("scatter", [1e-3, 3.5e-3])
def test_how_parallel_lines_are_is_estimated(scatter):
    """Lines that are far better known than they are parallel are along one direction, not along several."""
    rng = np.random.default_rng(11)
    directions, _ = lines_along(rng, FRAME, 80, scatter)
    found = directions_from_lines(directions, np.tile(2e-4**2 * np.eye(3), (240, 1, 1)))
    assert len(found) == 3
    assert angles(found.vectors, FRAME).min(axis=1).max() < scatter
    assert (found.probability > 0.9).mean() > 0.95


def test_how_far_ends_deviate_is_estimated():
    """A pixel turns short lines more; lines off by several usual deviations still belong, and are held by less."""
    rng = np.random.default_rng(12)
    turned = np.exp(rng.uniform(np.log(1e-3), np.log(1e-2), 200))
    off = 0.3 * turned
    off[::10] *= 3.0
    truth = np.repeat(FRAME[:2], 100, axis=0)
    directions = unit(truth + off[:, None] * rng.normal(size=(200, 3)))
    found = directions_from_lines(
        directions, np.tile(1e-4**2 * np.eye(3), (200, 1, 1)), DirectionOptions(level=0.99), turned
    )
    assert len(found) == 2
    assert np.median(found.deviation) == pytest.approx(0.3, rel=0.4)
    assert found.deviation[::10].mean() > 1.2 * found.deviation[1::10].mean()
    assert (found.label[::10] >= 0).mean() >= 0.9 and (found.label >= 0).mean() > 0.97


def test_directions_near_each_other_stay_apart_and_heavy_tails_are_none():
    rng = np.random.default_rng(13)
    near = unit(FRAME[0] + np.radians(1.0) * FRAME[1])
    directions, covariance = lines_along(rng, np.array([FRAME[0], near]), 30, 2e-3)
    found = directions_from_lines(directions, covariance)
    assert len(found) == 2
    assert angles(found.vectors, np.array([FRAME[0], near])).min(axis=1).max() < 2e-3
    right = angles(found.vectors, FRAME[:1]).argmin()
    assert (found.label == np.repeat([right, 1 - right], 30)).mean() > 0.95
    tails = 2e-3 * np.sqrt(4.0 / rng.chisquare(4.0, 150))[:, None]
    directions = unit(FRAME[0] + tails * rng.normal(size=(150, 3)))
    assert len(directions_from_lines(directions, np.tile(2e-3**2 * np.eye(3), (150, 1, 1)))) == 1


def test_horizontal_lines_at_any_angle_share_no_direction():
    """Among many lines perpendicular to one direction some are nearly parallel by chance: surely so are few."""
    options, sure = DirectionOptions(min_coincidences=2), 0
    for seed in range(10):
        rng = np.random.default_rng([14, seed])
        angle = rng.uniform(0.0, np.pi, 60)
        level = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(60)])
        true = np.concatenate([np.tile([0.0, 0.0, 1.0], (40, 1)), level])
        directions = unit(true + 3e-3 * rng.normal(size=(100, 3)))
        found = directions_from_lines(directions, np.tile(3e-3**2 * np.eye(3), (100, 1, 1)), options)
        certain = (found.label >= 0) & (found.probability > 0.9)
        assert certain[:40].sum() >= 38
        sure += certain[40:].sum()
    assert sure <= 12  # of 600


def test_nearly_parallel_lines_are_told_from_parallel_ones():
    """Shutters open by one to nine degrees, among lines of a facade that deviate by a pixel or less."""
    wrong = right = 0
    for seed in range(10):
        rng = np.random.default_rng([15, seed])
        turned = np.exp(rng.uniform(np.log(2e-3), np.log(1e-2), 60))
        opened = np.radians(rng.uniform(1.0, 9.0, 16))[:, None] * unit(rng.normal(size=(16, 3)))
        truth = np.tile(FRAME[0], (60, 1))
        truth[:16] = unit(truth[:16] + opened)
        directions = unit(truth + 0.4 * turned[:, None] * rng.normal(size=(60, 3)))
        found = directions_from_lines(
            directions, np.tile(5e-4**2 * np.eye(3), (60, 1, 1)), DirectionOptions(level=0.99), turned
        )
        along = (found.label == 0) & (found.probability > 0.9)
        wrong, right = wrong + along[:16].sum(), right + along[16:].sum()
    assert wrong <= 12 and right > 0.9 * 440  # of 160; some of the shutters are as good as closed


def test_an_uncertain_line_is_likelier_along_a_direction_of_many_lines():
    """Known to half a degree: of few others nobody knows how many lines are only nearly along their direction."""
    probability = []
    for sure in (4, 30):
        rng = np.random.default_rng(20)
        sigma = np.append(np.full(sure, 1e-3), 1e-2)
        lines = unit(FRAME[2] + 0.3 * sigma[:, None] * rng.choice([-1, 1], (sure + 1, 3)))
        wild = unit(rng.normal(size=(20, 3)))
        noise = np.concatenate([sigma, np.full(20, 1e-3)])[:, None, None] ** 2 * np.eye(3)
        found = directions_from_lines(np.concatenate([lines, wild]), noise)
        assert len(found) == 1 and (found.label[: sure + 1] == 0).all() and found.probability[:sure].min() > 0.95
        probability.append(found.probability[sure])
    # Jeffreys' prior: shares of 5.5 and 0.5 lines, of which the densities tell by 1 + (8.7 / 10)^2 at most: 0.95.
    assert probability[0] < 0.955 < 0.98 < probability[1]
