# SPDX-License-Identifier: BSD-3-Clause
"""jaxls on a BAL file, on the CPU in double precision: ``jaxls_solve.py FILE SOLVER THREADS``.

SOLVER is ``dense_cholesky``, ``conjugate_gradient`` or ``cholmod``. It is compiled by a first solve that does not
count, as groma's kernels are. Costs by step are known, times by step are not: the curve spreads the time evenly. Needs
numpy, jax and jaxls, not groma.
"""

from __future__ import annotations

import os
import sys

threads = int(sys.argv[3])
# XLA has no other way to limit its threads
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])
os.environ["JAX_PLATFORMS"] = "cpu"

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import jaxls  # noqa: E402
import numpy as np  # noqa: E402
from _common import MAX_STEPS, TOLERANCE, Clock, read_bal, report  # noqa: E402

jax.config.update("jax_enable_x64", True)


class Camera(jaxls.Var[jax.Array], default_factory=lambda: jnp.zeros(9)):
    """Rotation vector, translation, focal length, two of distortion."""


class Point(jaxls.Var[jax.Array], default_factory=lambda: jnp.zeros(3)):
    """A point."""


def residual(values, camera, point, pixel):
    """Return predicted minus measured pixel."""
    c, x = values[camera], values[point]
    angle = jnp.sqrt(c[:3] @ c[:3] + 1e-20)
    axis = c[:3] / angle
    turned = x * jnp.cos(angle) + jnp.cross(axis, x) * jnp.sin(angle) + axis * (axis @ x) * (1 - jnp.cos(angle))
    place = turned + c[3:6]
    image = -place[:2] / place[2]
    square = image @ image
    return c[6] * (1 + square * (c[7] + c[8] * square)) * image - pixel


def main() -> None:
    path, solver = sys.argv[1:3]
    camera_of, point_of, pixels, cameras, points = read_bal(path)
    camera_ids, point_ids = Camera(jnp.arange(len(cameras))), Point(jnp.arange(len(points)))
    cost = jaxls.Cost(residual, (Camera(jnp.array(camera_of)), Point(jnp.array(point_of)), jnp.array(pixels)))
    problem = jaxls.LeastSquaresProblem([cost], [camera_ids, point_ids]).analyze()
    start = jaxls.VarValues.make([camera_ids.with_value(jnp.array(cameras)), point_ids.with_value(jnp.array(points))])
    rule = jaxls.TerminationConfig(
        max_iterations=MAX_STEPS, cost_tolerance=TOLERANCE, gradient_tolerance=0.0, parameter_tolerance=0.0
    )

    def run():
        found = problem.solve(start, linear_solver=solver, verbose=False, return_summary=True, termination=rule)
        return jax.block_until_ready(found)

    run()
    clock = Clock()
    _, summary = run()
    times = clock.read()
    steps = int(summary.iterations)
    # it counts whole squares, without the half
    costs = np.minimum.accumulate(0.5 * np.asarray(summary.cost_history)[: steps + 1])
    share = np.linspace(0, 1, len(costs))
    curve = [[times["cpu_s"] * s, times["wall_s"] * s, float(c)] for s, c in zip(share, costs, strict=True)]
    report(
        contestant="jaxls",
        version=jaxls.__version__,
        solver=solver,
        threads=threads,
        **times,
        curve=curve,
        iterations=steps,
        initial_cost=float(costs[0]),
        final_cost=float(costs[-1]),
    )


if __name__ == "__main__":
    main()
