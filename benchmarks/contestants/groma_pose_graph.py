# SPDX-License-Identifier: BSD-3-Clause
"""groma on a pose graph: ``groma_pose_graph.py FILE RADIANS``; RADIANS is written for readers without half angles.

A first adjustment of a few steps puts kernels into memory, as a peer has been compiled before, too.
"""

from __future__ import annotations

import sys

import numpy as np
from _common import TOLERANCE, Clock, report

import groma
from groma.adjustment.graphs.pose_graph import PoseGraphOptions, pose_graph_problem
from groma.io.g2o import read_g2o, write_g2o
from groma.scene.pose_graph import PoseGraph
from groma.solver.options import SolverOptions
from groma.solver.solve import solve


def in_radians(graph: PoseGraph) -> PoseGraph:
    """Return the graph whose file states, as it is written, the information of ``graph`` per square radian."""
    if graph.planar:
        return graph
    halves = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
    return graph.replace(
        motions=graph.motions.replace(information=graph.motions.information * np.outer(halves, halves))
    )


def main() -> None:
    graph = read_g2o(sys.argv[1])
    write_g2o(in_radians(graph), sys.argv[2], force=True)
    problem = pose_graph_problem(graph, PoseGraphOptions())
    rule = SolverOptions(max_iterations=100, function_tolerance=TOLERANCE, threads=1)
    solve(problem, SolverOptions(max_iterations=2, threads=1))
    clock = Clock()
    solved = solve(problem, rule).report
    report(
        contestant="groma", version=groma.__version__, **clock.read(), iterations=solved.iterations,
        initial_cost=solved.initial_cost, final_cost=solved.final_cost, solver=solved.linear_solver,
    )  # fmt: skip


if __name__ == "__main__":
    main()
