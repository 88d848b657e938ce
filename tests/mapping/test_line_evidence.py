# SPDX-License-Identifier: BSD-3-Clause
"""Edges and texture told apart by the images that show a line and those that should; which images should."""

from dataclasses import replace

import numpy as np
import pytest
from _wireframe import arc, random_lines, wireframe
from scipy.special import logit

from groma.gates import NORMAL
from groma.mapping.lines.filtering.texture import TextureGates, _cost, _minimum, edge_odds, num_expected
from groma.mapping.lines.linking.tracks import Tracks
from groma.mapping.lines.views import build_views

EDGE, TEXTURE = TextureGates().edge, TextureGates().texture
TEXTURE_ODDS = logit(NORMAL.significance)


def population(rng, count, rate, length, leftover, expected=12):
    """Lines of three images and more drawn from an urn: lengths of their and of leftover segments, seen, expected."""
    chance = rng.beta(rate[0] * rate[1], (1.0 - rate[0]) * rate[1], 100 * count)
    seen = 1 + rng.binomial(expected - 1, chance)
    seen = seen[seen >= 3][:count]
    lengths = length * np.exp(rng.normal(0.0, 0.3, seen.sum() + leftover))
    return lengths, seen, np.full(count, expected)


def odds_of(*parts):
    """Log odds of all lines of the parts, and the number of the part that each is from."""
    length, line_of, kind = [], [], []
    for number, (lengths, seen, _) in enumerate(parts):
        rows = np.full(len(lengths), -1)
        rows[: seen.sum()] = len(kind) + np.repeat(np.arange(len(seen)), seen)
        length, line_of, kind = [*length, lengths], [*line_of, rows], kind + [number] * len(seen)
    length, line_of = np.concatenate(length), np.concatenate(line_of)
    seen, expected = (np.concatenate([part[k] for part in parts]) for k in (1, 2))
    kinds = (length, np.ones(len(length)))
    return edge_odds(kinds, line_of, np.ones(len(length), bool), seen, expected, 3), np.array(kind)


def test_texture_goes_and_edges_stay():
    rng = np.random.default_rng(0)
    edges, texture = population(rng, 200, EDGE, 60.0, 100), population(rng, 150, TEXTURE, 20.0, 3000)
    odds, kind = odds_of(edges, texture)
    keep = odds >= TEXTURE_ODDS
    assert keep[kind == 0].mean() > 0.97
    assert keep[kind == 1].mean() < 0.1


def test_the_record_counts_where_segments_look_alike():
    """Of lines of the same lengths those that are seen where they should be are kept before the others."""
    rng = np.random.default_rng(1)
    odds, kind = odds_of(population(rng, 100, EDGE, 25.0, 100), population(rng, 150, TEXTURE, 25.0, 3000))
    assert np.median(odds[kind == 0]) > np.quantile(odds[kind == 1], 0.95)


def test_nothing_goes_where_nothing_is_texture():
    rng = np.random.default_rng(2)
    odds, _ = odds_of(population(rng, 150, EDGE, 60.0, 200))
    assert (odds >= TEXTURE_ODDS).mean() > 0.99
    assert (population(rng, 150, EDGE, 60.0, 200)[1] == 3).any()


def test_few_lines_and_none():
    none = np.zeros(0, np.int64)
    assert len(edge_odds((np.zeros(0),), none, np.zeros(0, bool), none, none, 3)) == 0
    one = edge_odds((np.full(3, 30.0),), np.zeros(3, np.int64), np.ones(3, bool), np.array([3]), np.array([3]), 3)
    assert one[0] > TEXTURE_ODDS


@pytest.mark.parametrize("size", [(640.0, 480.0), (300.0, 200.0), (0.0, 0.0)])
def test_images_that_should_show_a_line(size):
    rng = np.random.default_rng(3)
    world = wireframe(arc(5), random_lines(20, rng), rng)
    views, line_of = build_views(world.scene, world.segments, 5.0, 0.1, 2.0), np.concatenate(world.truth)
    tracks = replace(Tracks.none(views, np.zeros(len(line_of), np.int64)), lines=world.lines, line_of=line_of)
    neighbors: list[np.ndarray] = [np.delete(np.arange(5), i) for i in range(5)]
    counted = num_expected(tracks, neighbors, np.tile(np.array(size, int), (5, 1)), 30.0)
    limit = np.where(np.array(size) > 0, size, np.inf)
    t = np.linspace(0.0, 1.0, 2001)[:, None]
    least, most = tracks.num_images(), tracks.num_images()
    for n, (a, b) in enumerate(world.lines):
        if not (tracks.line_of == n).any():
            continue
        places, shown = a + t * (b - a), []
        for P in tracks.views.camera:
            x = places @ P[:, :3].T + P[:, 3]
            pixel = x[:, :2] / x[:, 2:]
            inside = ((pixel >= 0) & (pixel <= limit)).all(1)
            steps = np.linalg.norm(np.diff(pixel, axis=0), axis=1)
            shown.append(steps[inside[1:] & inside[:-1]].sum())
        least[n] = max(least[n], (np.array(shown) >= 30.5).sum())
        most[n] = max(most[n], (np.array(shown) >= 29.5).sum())
    assert ((least <= counted) & (counted <= most)).all()
    assert (counted[np.unique(tracks.line_of[tracks.line_of >= 0])] > 0).all()


def test_the_derivatives_of_the_cost_are_those_of_differences():
    """Central differences over 1e-4 are wrong by 1e-8 of third derivatives, which the 80 rows leave below 100."""
    rng = np.random.default_rng(5)
    lines, leftover = (np.column_stack([np.ones(count), rng.normal(size=(count, 2))]) for count in (30, 50))
    given = lines, rng.normal(0.0, 2.0, 30), leftover, np.array([10.0, 1.5, 1.5]), np.array([-2.5, -0.5])
    at, step = rng.normal(size=5), 1e-4
    _, slope, bend = _cost(*given, at)
    around = [(_cost(*given, at + step * one), _cost(*given, at - step * one)) for one in np.eye(5)]
    np.testing.assert_allclose(slope, [(plus[0] - minus[0]) / (2.0 * step) for plus, minus in around], atol=1e-6)
    np.testing.assert_allclose(bend, [(plus[1] - minus[1]) / (2.0 * step) for plus, minus in around], atol=1e-6)


@pytest.mark.parametrize("start", [(-1.2, 1.0), (0.0, 3.0), (1.0, 1.0)])
def test_newton_finds_the_minimum_also_where_the_cost_bends_down(start):
    """Rosenbrock's valley; above it, at (0, 3), one curvature is negative."""

    def valley(p):
        (x, y), rise = p, p[1] - p[0] ** 2
        slope = np.array([-400.0 * x * rise - 2.0 * (1.0 - x), 200.0 * rise])
        return (
            (1.0 - x) ** 2 + 100.0 * rise**2,
            slope,
            np.array([[1200.0 * x**2 - 400.0 * y + 2.0, -400.0 * x], [-400.0 * x, 200.0]]),
        )

    np.testing.assert_allclose(_minimum(valley, np.array(start)), 1.0, atol=1e-5)
