# SPDX-License-Identifier: BSD-3-Clause
"""The comparison of line charts: a small run gives the ranking that the page states, and the reasons it gives."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from groma.adjustment.adjust import AdjustOptions
from groma.geometry.charts.line_charts import LINE_CHARTS

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture
def charts(monkeypatch):
    """The benchmark, on few lines."""
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.delitem(sys.modules, "charts", raising=False)
    module = importlib.import_module("charts")
    monkeypatch.setattr(module, "LINES", 40)
    return module


def test_the_default_reaches_the_minimum_where_others_do_not(charts):
    assert AdjustOptions().line_chart == "cartesian"
    near = {name: np.mean(charts.measure(name, 1.0, 1.0, 0.0)["converged"]) for name in LINE_CHARTS}
    far = {name: charts.measure(name, 1.0, 1.0, 100.0) for name in LINE_CHARTS}
    share = {name: np.mean(row["converged"]) for name, row in far.items()}
    best = max(share, key=lambda name: share[name])
    assert best == "cartesian" and share[best] > 0.9
    assert all(share[name] < 0.75 < near[name] for name in LINE_CHARTS if name != best)
    steps = {name: row["iterations"][1] for name, row in far.items()}  # from a start 3 % off
    assert all(steps[name] > 2 * steps[best] for name in LINE_CHARTS if name != best)


def test_turning_in_place_bends_with_the_distance_and_the_square_of_the_angle(charts):
    for name in LINE_CHARTS:
        small, large, far = (charts.bend(name, *at) for at in ((10.0, 0.02), (10.0, 0.1), (100.0, 0.1)))
        if name == "cartesian":
            assert max(small, large, far) < 1e-12
        else:
            assert large / small == pytest.approx(25, rel=0.05)
            assert far / large == pytest.approx(10, rel=0.15)


def test_neither_condition_nor_damping_tell_the_charts_apart(charts):
    rows = {(row["chart"], row["distance"]): row for row in charts.why((0.0, 100.0))}
    for name in LINE_CHARTS:
        assert rows[name, 100.0]["condition"] > 1e3 * rows[name, 0.0]["condition"]
        with_damping, without = rows[name, 100.0]["share"].values()
        assert without == pytest.approx(with_damping, abs=0.15)
