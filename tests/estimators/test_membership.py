# SPDX-License-Identifier: BSD-3-Clause
"""Members of structures that are not exact: how far they deviate, and whether the probabilities can be believed."""

import numpy as np
import pytest

from groma.estimators.membership import Candidates, averaged_memberships, memberships

HALF = 1.0


def mixed(rng, deviation, axes, members=600, clutter=400):
    """Offsets of members and of clutter, all with noise of their own; which are members."""
    number = members + clutter
    sigma = rng.uniform(0.01, 0.08, (number, axes))
    unit = rng.uniform(0.5, 2.0, number)
    offset = rng.normal(0.0, np.hypot(sigma, (deviation * unit)[:, None]))
    offset[members:] = rng.uniform(-HALF, HALF, (clutter, axes))
    return offset, sigma**2, unit, np.arange(number) < members


def candidates(offset, variance, unit, owner=None):
    number, axes = offset.shape
    owner = np.zeros(number, np.int64) if owner is None else owner
    density = np.full(number, (0.5 / HALF) ** axes)
    return Candidates(owner, offset, variance, unit, density, np.ones(number, bool), owner)


@pytest.mark.parametrize("axes", [1, 2])
@pytest.mark.parametrize("deviation", [0.0, 0.1])
def test_deviation_and_probability_are_those_of_the_mixture(axes, deviation):
    rng = np.random.default_rng(axes)
    offset, variance, unit, member = mixed(rng, deviation, axes)
    told = memberships(candidates(offset, variance, unit), np.array([0.5]))
    if deviation:  # steps of two fifths
        assert told.deviation[0] == pytest.approx(deviation, rel=0.3)
    else:
        assert told.deviation[0] == 0.0
    # As many members as the probabilities say, in all and where they are in between.
    for low, high in ((0.0, 1.0), (0.3, 0.9), (0.9, 1.0)):
        rows = (told.probability >= low) & (told.probability <= high)
        spread = np.sqrt((told.probability[rows] * (1.0 - told.probability[rows])).sum())
        assert abs(told.probability[rows].sum() - member[rows].sum()) < 4.0 * spread + 0.06 * rows.sum()  # steps


@pytest.mark.parametrize("deviation", [0.0, 0.1, 0.19])
def test_averaged_over_deviations_probabilities_are_those_of_the_mixture(deviation):
    """Also where members deviate almost as far as they may, which the most likely deviation takes for clutter."""
    rng = np.random.default_rng(8)
    offset, variance, unit, member = mixed(rng, deviation, 1)
    unit[:] = 1.0
    offset[member, 0] = rng.normal(0.0, np.hypot(np.sqrt(variance[member, 0]), deviation))
    found, most = candidates(offset, variance, unit), np.array([0.2])
    told = averaged_memberships(found, most, np.ones(1))
    assert told.deviation[0] == pytest.approx(deviation, rel=0.3, abs=0.02)
    spread = np.sqrt((told.probability * (1.0 - told.probability)).sum())
    assert abs(told.probability.sum() - member.sum()) < 4.0 * spread + 0.06 * len(member)
    # What tells nothing of the deviation leaves it anywhere up to the largest one.
    unknown = averaged_memberships(found, most, np.zeros(1)).deviation[0]
    assert 0.04 < unknown < 0.16


def test_averages_of_nothing():
    told = averaged_memberships(candidates(np.zeros((0, 1)), np.zeros((0, 1)), np.zeros(0)), np.ones(2), np.ones(2))
    assert len(told.probability) == 0 and told.deviation.tolist() == [0.0, 0.0]


def test_an_uncertain_axis_does_not_hide_a_certain_one():
    """Features are spread over the second axis by noise; the first tells members from clutter."""
    rng = np.random.default_rng(5)
    offset, variance, unit, member = mixed(rng, 0.0, 2)
    variance[:, 1] = 0.3**2
    offset[:, 1] = np.where(member, rng.normal(0.0, 0.3, len(member)), offset[:, 1])
    probability = memberships(candidates(offset, variance, unit), np.array([0.5])).probability
    assert (probability[member] > 0.8).mean() > 0.9
    assert (probability[~member] > 0.8).mean() < 0.05


def test_structures_have_deviations_of_their_own():
    rng = np.random.default_rng(6)
    parts = [mixed(rng, deviation, 1) for deviation in (0.0, 0.12)]
    offset, variance, unit = (np.concatenate([part[k] for part in parts]) for k in range(3))
    owner = np.repeat([0, 1], [len(part[0]) for part in parts])
    found, most = candidates(offset, variance, unit, owner), np.array([0.5, 0.5])
    own = memberships(found, most).deviation
    assert own[0] == 0.0 and own[1] == pytest.approx(0.12, rel=0.3)


def test_what_does_not_stand_out_has_no_deviation():
    rng = np.random.default_rng(7)
    offset, variance, unit, _ = mixed(rng, 0.0, 1, members=0, clutter=500)
    told = memberships(candidates(offset, variance, unit), np.array([0.5]))
    assert told.deviation[0] == 0.0 and (told.probability < 0.9).all()
    nothing = memberships(candidates(offset[:0], variance[:0], unit[:0]), np.array([0.5, 0.5]))
    assert len(nothing.probability) == 0 and nothing.deviation.tolist() == [0.0, 0.0]
