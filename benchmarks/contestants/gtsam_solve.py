# SPDX-License-Identifier: BSD-3-Clause
"""GTSAM on a BAL file: ``gtsam_solve.py FILE SOLVER THREADS``.

SOLVER is ``schur`` or ``full``, the two ways of its optimiser for structure from motion (4.3). Its parameters are those
that it calls Ceres' defaults; it steps until the common rule is met. Needs numpy and gtsam, not groma.
"""

from __future__ import annotations

import sys
from importlib.metadata import version

import gtsam
from _common import MAX_STEPS, TOLERANCE, Curve, report

#: Keys of points begin here, those of cameras at 0.
POINTS = 1 << 32


def build(path: str) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return factors and start."""
    data = gtsam.SfmData.FromBalFile(path)
    noise = gtsam.noiseModel.Unit.Create(2)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i in range(data.numberCameras()):
        values.insert(i, data.camera(i))
    for j in range(data.numberTracks()):
        track = data.track(j)
        values.insert(POINTS + j, track.point3())
        for k in range(track.numberMeasurements()):
            i, pixel = track.measurement(k)
            graph.add(gtsam.GeneralSFMFactorCal3Bundler(pixel, noise, i, POINTS + j))
    return graph, values


def main() -> None:
    path, solver, threads = sys.argv[1:]
    graph, values = build(path)
    # undamped, its default, the free gauge makes the system singular
    parameters = gtsam.SfmLevenbergMarquardtParams()
    modes = gtsam.SfmEliminationMode
    parameters.setEliminationMode(modes.Schur if solver == "schur" else modes.Full)
    parameters.setlambdaInitial(1e-4)
    parameters.setlambdaFactor(2.0)
    parameters.setDiagonalDamping(True)
    parameters.setUseFixedLambdaFactor(False)
    initial = graph.error(values)
    curve = Curve()
    curve.add(initial)
    optimizer = gtsam.SfmLevenbergMarquardtOptimizer(graph, values, parameters)
    cost = initial
    while optimizer.iterations() < MAX_STEPS:
        before = optimizer.iterations()
        optimizer.iterate()
        previous, cost = cost, optimizer.error()
        curve.add(cost)
        if previous - cost <= TOLERANCE * previous or optimizer.iterations() == before:
            break
    report(
        contestant="gtsam",
        version=version("gtsam"),
        solver=solver,
        threads=int(threads),
        **curve.finish(),
        iterations=int(optimizer.iterations()),
        initial_cost=float(initial),
        final_cost=float(cost),
    )


if __name__ == "__main__":
    main()
