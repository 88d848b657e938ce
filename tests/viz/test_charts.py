# SPDX-License-Identifier: BSD-3-Clause
"""The inline charts: well-formed for ordinary, empty and absurd numbers, and what they show is in them."""

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass

import numpy as np
import pytest

from groma.viz.report import charts as _charts


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
    assert "1.000 → 0.900" in svg and "2.000 → 0.500" in svg  # the same decimals before and after


def test_bars_of_nothing():
    _tree(_charts.bars([], None, np.zeros(0)))


def test_stages_begin_where_they_begin():
    """Each stage starts at its own cost; curves of different losses are not joined."""
    steps = [Step(1, 50.0, True), Step(2, 40.0, True), Step(3, 8.0, True)]
    rows = [{**vars(step), "stage": 1 + (step.iteration > 2)} for step in steps]
    stages = [
        {"loss": "cauchy", "initial_cost": 100.0, "first_step": 1},
        {"loss": "geman_mcclure", "initial_cost": 9.0, "first_step": 3},
    ]
    tree = _tree(_charts.convergence(rows, stages))
    assert len(list(tree.iter("circle"))) == 5
    assert [path.get("d").count("L") for path in tree.iter("path")] == [2, 1]
    assert {"Cauchy", "Geman-McClure"} <= {text.text for text in tree.iter("text")}


@pytest.mark.parametrize("values", [[], [2], [2, 3, 3], [5] * 10, list(range(2, 200))])
def test_tracks(values):
    tree = _tree(_charts.tracks({"points": np.array(values, int), "lines": np.array([3, 4])}))
    heights = [sum(float(bar.get("height")) for bar in group) for group in tree.iter("g")]
    assert len(heights) == 2 and heights[1] > 0 and (heights[0] > 0) == (len(values) > 0)


def test_shares_leave_out_what_there_is_none_of():
    text = _charts.shares([("<a>", 300, "red"), ("b", 1, "blue"), ("c", 0, "green")])
    assert "&lt;a&gt;" in text and "under 1 %" in text and "green" not in text
    assert _charts.shares([]) == '<div class="shares"></div><div class="keys"></div>'
