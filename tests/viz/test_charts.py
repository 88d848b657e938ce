# SPDX-License-Identifier: BSD-3-Clause
"""The inline charts: well-formed for ordinary, empty and absurd numbers, and what they show is in them."""

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass

import numpy as np
import pytest

from groma.viz import _charts


def _tree(svg: str) -> ElementTree.Element:
    assert "nan" not in svg and "inf" not in svg
    return ElementTree.fromstring(svg)


def test_histogram_shows_both_states():
    rng = np.random.default_rng(0)
    tree = _tree(_charts.histogram(rng.rayleigh(5.0, 1000), rng.rayleigh(0.5, 1000)))
    assert {group.get("class") for group in tree.iter("g")} == {"before", "after"}


@pytest.mark.parametrize("values", [[], [0.0, 0.0], [1e-300, 1e300], [1.0]])
def test_histogram_of_odd_values(values):
    _tree(_charts.histogram(None, np.array(values, dtype=float)))


@dataclass
class Step:
    iteration: int
    cost: float
    accepted: bool


def test_convergence_takes_objects_and_mappings():
    steps = [Step(0, 1e6, True), Step(1, 2e6, False), Step(2, 1e3, True)]
    from_objects = _charts.convergence(steps)
    assert from_objects == _charts.convergence([vars(step) for step in steps])
    marks = [circle.get("class") for circle in _tree(from_objects).iter("circle")]
    assert marks == ["after", "rejected", "after"]


@pytest.mark.parametrize("costs", [[], [0.0], [1.0], [5.0, 5.0], [math.inf, 1.0, math.nan], [1e-30, 1e30]])
def test_convergence_of_odd_costs(costs):
    _tree(_charts.convergence([Step(i, cost, True) for i, cost in enumerate(costs)]))


def test_bars_show_the_worst_first_and_escape_names():
    names = ["<b>bad</b>", "good.jpg"]
    svg = _charts.bars(names, np.array([2.0, 1.0]), np.array([0.5, 0.9]))
    tree = _tree(svg)
    shown = [text.text for text in tree.iter("text") if text.text in names]
    assert shown == ["good.jpg", "<b>bad</b>"]


def test_bars_of_nothing():
    _tree(_charts.bars([], None, np.zeros(0)))
