# SPDX-License-Identifier: BSD-3-Clause
"""Charts of lines compared: convergence basin, iterations and cost per iteration.

Lines of known place are seen by known cameras on a path, with noise, and are started from a disturbed place. Every line
is a least-squares problem of its own, solved by Levenberg-Marquardt in each chart; so what differs is the chart alone.
Varied are the noise, the baseline (length of the path over the distance) and the distance of the scene from the origin.

    python benchmarks/charts.py [--json FILE]     the tables of docs/evidence/line-charts.md, under a minute
    python benchmarks/charts.py --why             the table of reasons there, some seconds
"""

from __future__ import annotations

import argparse
import json
import time

import numpy as np

from groma.factors.contract import Ref
from groma.factors.observations.line_reprojection import LineReprojection
from groma.geometry import quaternion
from groma.geometry.charts.line_charts import LINE_CHARTS
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.geometry.manifold import Euclidean
from groma.problem.lay_out import lay_out
from groma.problem.linearization import NormalEquations, to_solver_order
from groma.problem.parallel import Workers
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.solver.independent import IndependentBlocks

FOCAL, VIEWS, LINES, STEPS = 800.0, 6, 200, 60
NOISES = (0.2, 1.0, 3.0)
BASELINES = (0.05, 0.2, 1.0)
DISTANCES = (0.0, 1.0, 10.0, 100.0)
#: Starts: end points moved by this share of the viewing distance, standard deviation per coordinate.
STARTS = (0.01, 0.03, 0.1, 0.2, 0.3, 0.5)
VIEWING_DISTANCE = 5.0
#: Where the scene lies when it is away from the origin.
AWAY = np.array([0.6, 0.64, 0.48])
#: Turns in place and initial dampings of the table of reasons.
ANGLES, DAMPINGS = (0.02, 0.1), (1e-4, 1e-10)


def problem_of(rng, chart, noise: float, baseline: float, distance: float, start: float) -> tuple[Problem, Problem]:
    """Return a problem from a disturbed start, and the same from the truth."""
    offset = distance * AWAY
    x = np.linspace(-0.5, 0.5, VIEWS) * baseline * VIEWING_DISTANCE
    centers = np.column_stack([x, np.full(VIEWS, -VIEWING_DISTANCE), 0.2 * x**2])
    z = -centers / np.linalg.norm(centers, axis=1, keepdims=True)
    right = np.cross(z, [0, 0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    R = np.stack([right, np.cross(z, right), z], axis=1)
    poses = np.hstack([quaternion.from_matrix(R), -np.einsum("nij,nj->ni", R, centers + offset)])
    ends = rng.uniform(-1.0, 1.0, (LINES, 2, 3))
    line, camera = np.repeat(np.arange(LINES), VIEWS), np.tile(np.arange(VIEWS), LINES)
    seen = []
    for k in range(2):
        in_cam = np.einsum("nij,nj->ni", R[camera], ends[line, k] - centers[camera])
        seen.append(FOCAL * in_cam[:, :2] / in_cam[:, 2:] + [500.0, 400.0])
    segments = np.hstack(seen) + rng.normal(0, noise, (len(line), 4))
    factor = LineReprojection(
        pose=Ref("poses", camera), line=Ref("lines", line), intrinsics=Ref("intrinsics", np.zeros(len(line), int)),
        camera_model="PINHOLE", segments=segments, sqrt_information=1.0 / noise,
    )  # fmt: skip
    moved = ends + rng.normal(0, start * VIEWING_DISTANCE, ends.shape)
    problems = []
    for places in (moved + offset, ends + offset):
        plucker = np.hstack([np.cross(places[:, 0], places[:, 1]), places[:, 1] - places[:, 0]])
        variables = {
            "poses": Variables(POSE_CHARTS["left"], poses, True),
            "intrinsics": Variables(Euclidean(4, "intrinsics"), np.array([[FOCAL, FOCAL, 500.0, 400.0]]), True),
            "lines": Variables(chart, chart.from_ambient(plucker)),
        }
        problems.append(Problem(variables, [factor]))
    return problems[0], problems[1]


def run(problem: Problem, steps: int, damping: float = 1e-4) -> tuple[np.ndarray, float]:
    """Return the cost of every line after every step (steps + 1, lines), and processor seconds per step."""
    layout = lay_out(problem)
    blocks = IndependentBlocks(layout, Workers(1), damping, 1e-12)
    states = to_solver_order(layout)
    costs = blocks.costs(states)
    history = [costs[0].copy()]
    begin = time.process_time()
    for _ in range(steps):
        states, costs, _ = blocks.step(states, costs)
        history.append(costs[0].copy())
    return np.array(history), (time.process_time() - begin) / steps


def measure(name: str, noise: float, baseline: float, distance: float, seed: int = 0) -> dict:
    """Return basin, iterations and cost of one chart in one setting."""
    chart, converged, iterations, seconds = LINE_CHARTS[name], [], [], []
    for number, start in enumerate(STARTS):
        disturbed, _ = problem_of(np.random.default_rng([seed, number]), chart, noise, baseline, distance, start)
        # the minimum by the default chart from the truth, the same for all charts
        reference_problem = problem_of(
            np.random.default_rng([seed, number]), LINE_CHARTS["cartesian"], noise, baseline, distance, start
        )[1]
        least = run(reference_problem, STEPS)[0][-1]
        history, per_step = run(disturbed, STEPS)
        limit = least * 1.001 + 1e-9
        done = history <= limit
        converged.append(float(done[-1].mean()))
        iterations.append(float(np.median(np.argmax(done[:, done[-1]], axis=0))) if done[-1].any() else float("nan"))
        seconds.append(per_step)
    share = np.array(converged)
    good = np.flatnonzero(share >= 0.95)
    return {
        "chart": name, "noise_px": noise, "baseline": baseline, "distance": distance,
        "basin": STARTS[int(good[-1])] if len(good) else 0.0, "converged": converged, "iterations": iterations,
        "microseconds_per_line_and_step": 1e6 * float(np.median(seconds)) / LINES,
    }  # fmt: skip


def bend(name: str, distance: float, angle: float, seed: int = 0) -> float:
    """Return how far a line leaves its place, over the viewing distance, when a chart turns it in place; the median.

    The step is the one of first order that turns a line about its middle by ``angle`` radians. A chart in which turning
    in place is a straight motion keeps the middle on the line.
    """
    rng, chart = np.random.default_rng(seed), LINE_CHARTS[name]
    ends = rng.uniform(-1.0, 1.0, (LINES, 2, 3)) + distance * AWAY
    d = ends[:, 1] - ends[:, 0]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    middle = ends.mean(axis=1)
    axis = np.cross(d, rng.normal(size=d.shape))
    turn = np.cross(axis / np.linalg.norm(axis, axis=1, keepdims=True), d)
    state = chart.from_ambient(np.hstack([np.cross(middle, d), d]))
    L = chart.ambient(state)
    rate = np.hstack([np.cross(middle, turn), turn]) * (L[:, 3:] * d).sum(axis=1, keepdims=True)
    # the increments whose motion is the rate, up to the scale of (m, d), which means nothing
    rows = np.array([1.0 / max(distance, 1.0)] * 3 + [1.0] * 3)
    M = np.concatenate([np.asarray(chart.basis(state)), L[:, :, None]], axis=2) * rows[:, None]
    steps = np.stack([np.linalg.lstsq(A, b, rcond=None)[0][:4] for A, b in zip(M, rate * rows, strict=True)])
    moved = chart.ambient(chart.retract(state, angle * steps))
    gap = np.cross(middle, moved[:, 3:]) - moved[:, :3]
    return float(np.median(np.linalg.norm(gap, axis=1) / np.linalg.norm(moved[:, 3:], axis=1))) / VIEWING_DISTANCE


def condition(problem: Problem) -> float:
    """Return the median condition number of the normal matrices of the lines, scaled to a diagonal of ones."""
    layout = lay_out(problem)
    equations, states = NormalEquations(layout, Workers(1)), to_solver_order(layout)
    equations.linearize(states, equations.prepare(states))
    V = equations.V[0].reshape(-1, 4, 4)
    size = 1.0 / np.sqrt(np.einsum("nii->ni", V))
    values = np.linalg.eigvalsh(V * size[:, :, None] * size[:, None, :])
    return float(np.median(values[:, -1] / np.maximum(values[:, 0], 1e-300)))


def why(distances: tuple = DISTANCES) -> list[dict]:
    """Return what could make charts differ: condition, damping, and how much a turn in place bends the line away."""
    rows = []
    for name, chart in LINE_CHARTS.items():
        for distance in distances:
            settings = (1.0, 1.0, distance, 0.1)
            disturbed, true = problem_of(np.random.default_rng(0), chart, *settings)
            best = problem_of(np.random.default_rng(0), LINE_CHARTS["cartesian"], *settings)[1]
            limit = run(best, STEPS)[0][-1] * 1.001 + 1e-9
            share = {damping: float((run(disturbed, STEPS, damping)[0][-1] <= limit).mean()) for damping in DAMPINGS}
            rows.append(
                {"chart": name, "distance": distance, "condition": condition(true), "share": share}
                | {"bend": {angle: bend(name, distance, angle) for angle in ANGLES}}
            )
    return rows


def print_why() -> None:
    """Print the table of reasons."""
    dampings = " | ".join(f"reach it, damping {damping:g}" for damping in DAMPINGS)
    print(f"| chart | distance | condition | {dampings} | {' | '.join(f'bend at {angle} rad' for angle in ANGLES)} |")
    print("|---|" + "---|" * (2 + len(DAMPINGS) + len(ANGLES)))
    for row in why():
        shares = " | ".join(f"{100 * share:.0f} %" for share in row["share"].values())
        bends = " | ".join(f"{100 * bend:.2f} %" for bend in row["bend"].values())
        print(f"| `{row['chart']}` | {row['distance']:g} | {row['condition']:.0f} | {shares} | {bends} |")


def table(rows: list[dict], over: str, values: tuple) -> str:
    """Return a Markdown table: one line a chart, one column a value, averaged over the other settings."""
    head = f"| chart | {' | '.join(f'{over} {value:g}' for value in values)} |\n|---|{'---|' * len(values)}"
    lines = []
    for name in LINE_CHARTS:
        cells = []
        for value in values:
            chosen = [row for row in rows if row["chart"] == name and row[over] == value]
            share = 100 * np.mean([np.mean(row["converged"]) for row in chosen])
            steps = np.nanmean([row["iterations"][2] for row in chosen])
            cells.append(f"{share:.0f} % · {steps:.1f}")
        lines.append(f"| `{name}` | {' | '.join(cells)} |")
    return "\n".join([head, *lines])


def main() -> None:
    """Run all settings and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--why", action="store_true", help="print what could make the charts differ instead")
    chosen = parser.parse_args()
    if chosen.why:
        print_why()
        return
    rows = []
    for name in LINE_CHARTS:
        for noise in NOISES:
            for baseline in BASELINES:
                rows += [measure(name, noise, baseline, distance) for distance in DISTANCES]
    print("Share of lines that reach the minimum (all starts) · median steps from a start 10 % off\n")
    for over, values in (("distance", DISTANCES), ("baseline", BASELINES), ("noise_px", NOISES)):
        print(table(rows, over, values) + "\n")
    print("Share that reach the minimum by start:\n")
    print(f"| chart | {' | '.join(f'{start:.0%}' for start in STARTS)} | µs per line and step |")
    print("|---|" + "---|" * (len(STARTS) + 1))
    for name in LINE_CHARTS:
        mine = [row for row in rows if row["chart"] == name]
        shares = 100 * np.mean([row["converged"] for row in mine], axis=0)
        cost = np.median([row["microseconds_per_line_and_step"] for row in mine])
        print(f"| `{name}` | {' | '.join(f'{share:.1f} %' for share in shares)} | {cost:.1f} |")
    if chosen.json:
        with open(chosen.json, "w") as file:
            json.dump(rows, file, indent=1)


if __name__ == "__main__":
    main()
