# SPDX-License-Identifier: BSD-3-Clause
"""The pose of one image from landmarks that are held: 500 points and 100 lines, 200 different frames, warm."""

from __future__ import annotations

import time

import numpy as np
from _common import report

from groma.factors.contract import Ref
from groma.factors.losses import Huber
from groma.factors.observations.line_reprojection import LineReprojection
from groma.factors.observations.point_reprojection import PointReprojection
from groma.geometry.charts.line_charts import LINE_CHARTS
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.geometry.manifold import Euclidean
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

NUM_POINTS, NUM_LINES, FRAMES = 500, 100, 200
FOCAL, CENTER = 800.0, np.array([640.0, 480.0])


def problem_of(rng: np.random.Generator, points, ends, pluecker) -> Problem:
    """Return the problem of a new frame: measurements with noise, a start 2 degrees and 5 cm off."""
    pixel = FOCAL * points[:, :2] / points[:, 2:] + CENTER + rng.normal(0, 1, (NUM_POINTS, 2))
    segment = (FOCAL * ends[..., :2] / ends[..., 2:] + CENTER + rng.normal(0, 1, (NUM_LINES, 2, 2))).reshape(-1, 4)
    start = np.array([0, 0, 0, 1, 0, 0, 0.0])
    start[:3], start[4:] = rng.normal(0, 0.017, 3), rng.normal(0, 0.05, 3)
    start[:4] /= np.linalg.norm(start[:4])
    chart = LINE_CHARTS["cartesian"]
    variables = {
        "pose": Variables(POSE_CHARTS["left"], start[None]),
        "camera": Variables(Euclidean(4, "intrinsics"), np.array([[FOCAL, FOCAL, *CENTER]]), True),
        "points": Variables(Euclidean(3, "point"), points, True),
        "lines": Variables(chart, chart.from_ambient(pluecker), True),
    }
    zeros = np.zeros(NUM_POINTS, dtype=np.int64)
    shared = {"camera_model": "PINHOLE", "loss": Huber(2.0)}
    factors = [
        PointReprojection(
            pose=Ref("pose", zeros),
            intrinsics=Ref("camera", zeros),
            point=Ref("points", np.arange(NUM_POINTS)),
            pixels=pixel,
            **shared,
        ),
        LineReprojection(
            pose=Ref("pose", zeros[:NUM_LINES]),
            intrinsics=Ref("camera", zeros[:NUM_LINES]),
            line=Ref("lines", np.arange(NUM_LINES)),
            segments=segment,
            **shared,
        ),
    ]
    return Problem(variables, factors)


def main() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-3, -2, 4], [3, 2, 12], (NUM_POINTS, 3))
    ends = rng.uniform([-3, -2, 4], [3, 2, 12], (NUM_LINES, 2, 3))
    pluecker = np.hstack([np.cross(ends[:, 0], ends[:, 1]), ends[:, 1] - ends[:, 0]])
    options = SolverOptions(threads=1)
    solving, total, iterations, errors = [], [], [], []
    for _ in range(FRAMES):
        begin = time.process_time()
        problem = problem_of(rng, points, ends, pluecker)
        middle = time.process_time()
        result = solve(problem, options)
        end = time.process_time()
        solving.append(end - middle)
        total.append(end - begin)
        iterations.append(result.report.iterations)
        errors.append(np.linalg.norm(result.problem.variables["pose"].state[0, 4:]))
    report(
        solve_ms=1e3 * float(np.median(solving)),
        total_ms=1e3 * float(np.median(total)),
        iterations=float(np.median(iterations)),
        translation_error=float(np.median(errors)),
    )


if __name__ == "__main__":
    main()
