# SPDX-License-Identifier: BSD-3-Clause
"""Digits of numbers in charts and tables: even where they are compared, and ticks at round places."""

import math

import numpy as np
import pytest

from groma.viz.report import digits as _digits


@pytest.mark.parametrize(
    ("values", "shown"),
    [
        ([0.219, 0.2], ["0.219", "0.200"]),
        ([0.718, 0.755], ["0.718", "0.755"]),
        ([12.3456, 1.7], ["12.35", "1.70"]),
        ([1000.0, 2.0, 3.0], ["1,000.00", "2.00", "3.00"]),
        ([0.5, math.nan, math.inf], ["0.500", "–", "–"]),
        ([0.0, 0.0], ["0", "0"]),
        ([3e-12, 2e-12], ["3.0e-12", "2.0e-12"]),
        ([], []),
    ],
)
def test_numbers_that_are_compared_have_the_same_decimals(values, shown):
    assert _digits.even(values) == shown


@pytest.mark.parametrize(
    ("values", "shown"),
    [
        ([8170.0, 5680.0], ["8.17 k", "5.68 k"]),
        ([850_910.0, 13_344.0], ["851 k", "13.3 k"]),
        ([2e6, 400.0], ["2 M", "400"]),
        ([0.718, 0.7], ["0.718", "0.700"]),
        ([math.nan], ["–"]),
    ],
)
def test_large_numbers_are_short(values, shown):
    assert _digits.short(values) == shown


def test_everything_is_a_hundred_per_cent():
    assert [_digits.percent(share) for share in (1.0, 0.996, 0.99, 0.0873)] == ["100 %", "100 %", "99 %", "8.7 %"]


@pytest.mark.parametrize("extent", [1e-9, 0.7, 1.0, 3.0, 4999.0, 1e12])
@pytest.mark.parametrize("most", [4, 5, 8])
def test_steps_are_round_and_not_too_many(extent, most):
    step = _digits.round_step(extent, most)
    leading = step / 10.0 ** math.floor(math.log10(step) + 1e-9)
    assert min(abs(leading - good) for good in (1, 2, 5)) < 1e-9
    assert most / 2.5 - 1e-9 <= extent / step <= most + 1e-9
    places = _digits.ticks(-extent, extent, step)
    assert 0.0 in np.round(places, 15) and max(map(abs, places)) <= extent * (1 + 1e-6)
    assert len({_digits.tick_of_step(place, step) for place in places}) == len(places)
