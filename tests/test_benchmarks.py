# SPDX-License-Identifier: BSD-3-Clause
"""The arithmetic of the benchmarks: growth, time to cost, verdicts, charts, and the derivatives a peer is given."""

import importlib
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture
def benchmark(monkeypatch):
    """Import a module of the benchmarks by name."""
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.syspath_prepend(str(FOLDER / "contestants"))

    def load(name):
        monkeypatch.delitem(sys.modules, name, raising=False)
        return importlib.import_module(name)

    return load


def test_growth_is_the_slope_of_the_logarithms(benchmark):
    scale = benchmark("scale")
    sizes = [0.5e6, 1e6, 2e6, 4e6]
    assert scale.exponent(sizes, [3e-6 * n**1.07 for n in sizes]) == pytest.approx(1.07)
    rows = [{"observations": n, "peak_memory_mib": 150 + 2e-4 * n, "process_mib": 150} for n in sizes]
    assert scale.straight_line(rows) == pytest.approx((150, 2e-4))
    assert scale.straight_line(rows[:1]) == pytest.approx((150, 2e-4))


def _row(name, curve, threads=1, rounds=3, solver="dense", initial=100.0):
    cpu, wall, cost = curve[-1]
    return {
        "contestant": name, "solver": solver, "threads": threads, "version": "1", "rounds": rounds, "cpu_s": cpu,
        "wall_s": wall, "iterations": len(curve), "initial_cost": initial, "final_cost": cost,
        "peak_memory_mib": 100.0, "curve": curve,
    }  # fmt: skip


def test_time_to_cost_and_ratios(benchmark):
    run = benchmark("run")
    rows = [
        _row("groma", [[0.1, 0.1, 20.0], [0.2, 0.2, 10.001], [0.3, 0.3, 10.0]]),
        _row("ceres", [[1.0, 1.0, 30.0], [2.0, 2.0, 10.0005], [2.5, 2.5, 10.0]]),
        _row("ceres", [[1.0, 1.0, 10.0]], rounds=1, solver="tried once"),
        _row("other", [[0.1, 0.1, 12.0]]),
        _row("smaller", [[0.01, 0.01, 1.0]], initial=90.0),
        _row("groma", [[0.35, 0.2, 10.0]], threads=2),
        _row("ceres", [[3.0, 1.4, 10.0]], threads=2),
    ]
    run.add_times_to_cost(rows)
    assert [row["cpu_to_cost_s"] for row in rows[:4]] == [0.2, 2.0, 1.0, None]
    assert not rows[4]["same_problem"]
    metrics = run.metrics_of(rows, unit=0.1)
    assert metrics["cpu_in_calibrations"] == pytest.approx(3.0)
    assert metrics["cpu_ratio_ceres"] == pytest.approx(2.5 / 0.3)
    assert metrics["time_to_cost_ratio_ceres"] == pytest.approx(10.0)
    assert "time_to_cost_ratio_other" not in metrics
    assert "cpu_ratio_smaller" not in metrics
    assert metrics["wall_ratio_two_threads"] == pytest.approx(7.0)
    text = run.table([{"title": "Scene", "contestants": rows}])
    assert text.count("| Scene |") == 1
    assert "smaller 1 (1)" in text


def test_a_verdict_knows_its_direction(benchmark):
    check = benchmark("check")
    lower = {"value": 10.0, "direction": "lower", "tolerance": 0.1, "limit": 10.5}
    assert check.verdict(lower, 10.4) == ""
    assert "limit" in check.verdict(lower, 10.8)
    assert "worse" in check.verdict(lower, 11.2)
    higher = {"value": 10.0, "direction": "higher", "tolerance": 0.1}
    assert check.verdict(higher, 20.0) == check.verdict(higher, 9.1) == ""
    assert check.verdict(higher, 8.9)


def test_a_chart_is_a_picture(benchmark, tmp_path):
    plots = benchmark("_plots")
    path = tmp_path / "chart.svg"
    lines = [plots.Line("one & only", [1, 10, 1000], [1e-7, 0.0, 5]), plots.Line("steps", [2, 20], [3, 4], steps=True)]
    plots.write(path, "a < b", "x", "y", lines)
    root = ElementTree.parse(path).getroot()
    texts = [element.text for element in root.iter("{http://www.w3.org/2000/svg}text")]
    assert {"one & only", "steps", "a < b"} <= set(texts)
    plots.write(tmp_path / "none.svg", "empty", "x", "y", [plots.Line("zero", [0], [0])])
    assert not (tmp_path / "none.svg").exists()


def test_the_derivatives_given_to_scipy_are_right(benchmark, tmp_path):
    problem_type = benchmark("scipy_solve").Problem
    rng = np.random.default_rng(0)
    cameras = np.column_stack([rng.normal(0, 0.3, (2, 6)), [500.0, 480], [-0.1, 0.05], [0.02, 0.01]])
    points = rng.uniform([-1, -1, -6], [1, 1, -3], (3, 3))
    rows = [f"{c} {p} {u} {v}" for c in range(2) for p in range(3) for u, v in [rng.uniform(-200, 200, 2)]]
    path = tmp_path / "bal.txt"
    path.write_text("2 3 6\n" + "\n".join([*rows, *map(str, cameras.ravel()), *map(str, points.ravel())]))
    problem = problem_type(str(path))
    start = problem.start()
    numeric = np.empty(problem.shape)
    for k in range(len(start)):
        step = np.zeros(len(start))
        step[k] = 1e-6 * max(1.0, abs(start[k]))
        numeric[:, k] = (problem.residuals(start + step) - problem.residuals(start - step)) / (2 * step[k])
    np.testing.assert_allclose(problem.jacobian(start).toarray(), numeric, rtol=1e-6, atol=1e-5)
    assert problem.pattern().nnz == 6 * 2 * 12


def _holistic_run(images, contestant, cpu_s, iterations=4, kind="lines", seed=0, line=1.0):
    errors = {"centre": 1.0, "point": 1.0, "line_deg": 1.0, "line": line, "plane_deg": 1.0, "plane": 1.0}
    return {
        "images": images, "views": "near", "seed": seed, "kind": kind, "contestant": contestant, "cpu_s": cpu_s,
        "iterations": iterations, "errors": errors,
    }  # fmt: skip


def test_holistic_promises(benchmark):
    holistic = benchmark("holistic")
    sizes = (100, 200, 500, 1000)
    runs = holistic.Runs([_holistic_run(n, "groma", 1e-5 * n**1.1) for n in sizes])
    for n in sizes:
        runs.add(_holistic_run(n, "limap", 1e-5 * n**1.1 * (11 if n >= 500 else 3.1), iterations=20))
    assert holistic.broken_promises(runs) == []
    assert holistic.growth(runs)["near", "lines"][0] == pytest.approx(1.1)
    runs.add(_holistic_run(1000, "groma", 1e-5 * 1000**1.1, iterations=9))
    assert len(runs.of(images=1000, contestant="groma")) == 1
    assert ["9 steps" in sentence for sentence in holistic.broken_promises(runs)] == [True]
    for n in sizes:
        runs.add(_holistic_run(n, "groma", 1e-7 * n**2))
    broken = " ".join(holistic.broken_promises(runs))
    assert "exponent 2.00" in broken and "times longer" in broken


def test_holistic_errors_are_compared_over_enough_scenes(benchmark):
    holistic = benchmark("holistic")
    rows = [_holistic_run(100, "groma", 1.0, seed=s, line=2.0) for s in range(10)]
    rows += [_holistic_run(100, "limap", 9.0, seed=s) for s in range(10)]
    assert len(holistic.broken_promises(holistic.Runs(rows))) == 1
    assert holistic.broken_promises(holistic.Runs(rows[:-1])) == []
    text = holistic.accuracy_table(holistic.Runs([{**row, "views": "random"} for row in rows]))
    assert "| lines | groma | 10 | 1.00 | 1.00 | 1.000° 2.00 | – |" in text
    assert "| lines | limap, as published | 10 | 4.37 | 5.39 | 0.309° 6.05 | – |" in text
