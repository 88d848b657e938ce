# SPDX-License-Identifier: BSD-3-Clause
"""GTSAM on a pose graph: ``gtsam_pose_graph.py FILE``, its Levenberg-Marquardt as it comes, the common stopping rule.

It takes the information of the file per square radian. Needs numpy and gtsam, not groma.
"""

from __future__ import annotations

import sys
from importlib.metadata import version

import gtsam
import numpy as np
from _common import MAX_STEPS, TOLERANCE, Clock, report


def main() -> None:
    path = sys.argv[1]
    with open(path) as file:
        is_3d = "SE3" in file.readline()
    graph, values = gtsam.readG2o(path, is_3d)
    still, certain = (gtsam.Pose3(), np.full(6, 1e-9)) if is_3d else (gtsam.Pose2(), np.full(3, 1e-9))
    first = min(values.keys())
    start = values.atPose3(first) if is_3d else values.atPose2(first)
    prior = gtsam.PriorFactorPose3 if is_3d else gtsam.PriorFactorPose2
    graph.add(prior(first, start if start is not None else still, gtsam.noiseModel.Diagonal.Sigmas(certain)))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(2 * MAX_STEPS)
    parameters.setRelativeErrorTol(TOLERANCE)
    parameters.setAbsoluteErrorTol(0.0)
    initial = graph.error(values)
    clock = Clock()
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    optimizer.optimize()
    times = clock.read()
    report(
        contestant="gtsam", version=version("gtsam"), **times, iterations=optimizer.iterations(),
        initial_cost=initial, final_cost=optimizer.error(),
    )  # fmt: skip


if __name__ == "__main__":
    main()
