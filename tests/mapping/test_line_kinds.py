# SPDX-License-Identifier: BSD-3-Clause
"""Kinds of segments: how often they are found again is learned, lines of texture go, and nothing goes without cause."""

import numpy as np
import pytest

from groma.mapping.lines.filtering.kinds import found_again, repeatability


def population(rng, count, length, strength, share, per_line=5):
    """Segments of one kind, of which a share lies on lines of ``per_line`` segments each."""
    lengths = length * np.exp(rng.normal(0.0, 0.3, count))
    strengths = strength * np.exp(rng.normal(0.0, 0.3, count))
    line_of = np.full(count, -1)
    mapped = int(share * count) // per_line * per_line
    line_of[rng.permutation(count)[:mapped]] = np.repeat(np.arange(mapped // per_line), per_line)
    return lengths, strengths, line_of


def together(*parts):
    """Segments of several kinds in one table; lines are numbered on, and the kind of each line is returned."""
    lengths, strengths = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    line_of, kind = [], []
    for number, part in enumerate(parts):
        line_of.append(np.where(part[2] >= 0, part[2] + len(kind), -1))
        kind += [number] * (int(part[2].max(initial=-1)) + 1)
    return lengths, strengths, np.concatenate(line_of), np.array(kind)


def kept(lengths, strengths, line_of, least=0.4):
    return found_again(
        lengths, strengths, line_of, np.ones(len(lengths), bool), int(line_of.max(initial=-1)) + 1, least
    )


def test_probability_is_learned():
    rng = np.random.default_rng(0)
    lengths, strengths = 30.0 * np.exp(rng.normal(0, 0.6, 20000)), 10.0 * np.exp(rng.normal(0, 0.5, 20000))
    true = 1.0 / (1.0 + np.exp(-(0.3 + 1.2 * np.log(lengths / 30.0) + 0.8 * np.log(strengths / 10.0))))
    found = repeatability(lengths, strengths, np.ones(20000, bool), rng.uniform(size=20000) < true)
    # The standard deviation of three fitted coefficients from 20 000 samples is about 0.02, that is 0.005 in p.
    assert np.abs(found - true).max() < 0.03


@pytest.mark.parametrize(("length", "strength"), [(14.0, 16.0), (60.0, 4.0), (16.0, 6.0)])
def test_texture_goes_and_edges_stay(length, strength):
    rng = np.random.default_rng(1)
    edges, texture = population(rng, 800, 80.0, 20.0, 0.9), population(rng, 2000, length, strength, 0.2)
    *table, kind = together(edges, texture)
    keep = kept(*table)
    assert keep[kind == 0].mean() > 0.95
    assert keep[kind == 1].mean() < 0.05
    assert kept(*table, least=0.0).all()


def test_nothing_goes_where_all_kinds_are_found_again():
    rng = np.random.default_rng(2)
    *table, kind = together(population(rng, 500, 80.0, 20.0, 0.95), population(rng, 500, 15.0, 6.0, 0.7))
    assert kept(*table).all() and len(np.unique(kind)) == 2


def test_nothing_goes_where_little_is_found_again_whatever_its_kind():
    """Few images, far apart: long, strong segments are not found more often than short, weak ones."""
    rng = np.random.default_rng(3)
    *table, _ = together(population(rng, 800, 80.0, 20.0, 0.25), population(rng, 800, 15.0, 6.0, 0.2))
    assert kept(*table).all()


def test_more_is_asked_where_less_is_found_again():
    """The same kinds, at the same rates: beside plain edges their lines stay, in a scene of texture they go."""
    rng = np.random.default_rng(4)
    edges, doubtful = population(rng, 3000, 80.0, 20.0, 0.95), population(rng, 600, 18.0, 8.0, 0.43)
    *table, kind = together(edges, doubtful)
    beside = kept(*table)[kind == 1].mean()
    *table, kind = together(population(rng, 800, 80.0, 20.0, 0.95), population(rng, 5000, 18.0, 8.0, 0.43))
    assert beside > 0.7
    assert kept(*table)[kind == 1].mean() < 0.3


def test_segments_that_could_not_be_found_do_not_count():
    rng = np.random.default_rng(5)
    lengths, strengths, line_of, _ = together(
        population(rng, 300, 80.0, 20.0, 0.9),
        population(rng, 300, 15.0, 6.0, 0.8),
        population(rng, 900, 15.0, 6.0, 0.0),
    )
    eligible = np.arange(1500) < 600
    count = int(line_of.max()) + 1
    assert found_again(lengths, strengths, line_of, eligible, count, 0.4).all()
    assert not found_again(lengths, strengths, line_of, np.ones(1500, bool), count, 0.4).all()


def test_edge_cases():
    none = np.zeros(0)
    assert len(found_again(none, none, np.zeros(0, np.int64), np.zeros(0, bool), 0, 0.4)) == 0
    few = np.full(6, 30.0)
    assert kept(few, np.zeros(6), np.array([0, 0, 0, -1, -1, -1])).all()  # segments from elsewhere, all alike
    assert kept(few, few, np.zeros(6, np.int64)).all()
    assert kept(few, few, np.full(6, -1)).shape == (0,)
