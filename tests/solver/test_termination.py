# SPDX-License-Identifier: BSD-3-Clause
"""When the cost counts as converged: taken from what the next step would bring, and never too early."""

import numpy as np
import pytest
from problems import scene_problem

from groma.solver.options import SolverOptions
from groma.solver.solve import solve
from groma.solver.termination import Termination, cost_converged


def test_a_small_decrease_has_converged():
    assert cost_converged(1e-6, 0.0, 0.0, 1.0, 1e-6)
    assert not cost_converged(1.1e-6, 0.0, 1.0, 0.0, 1e-6)  # no step before, so nothing is known of the next


@pytest.mark.parametrize(
    ("decrease", "previous", "gain_ratio", "withheld", "converged"),
    [
        (1e-5, 1e-2, 1.0, 0.0, True),  # steps shrink a thousandfold: the next brings 1e-8
        (1e-5, 2e-5, 1.0, 0.0, False),  # they shrink by half
        (1e-5, 1e-2, 0.8, 0.0, False),  # the model was wrong by a fifth
        (1e-5, 1e-2, 1.2, 0.0, False),
        (1e-5, 1e-2, 1.0, 2e-6, False),  # the damping holds back more than matters
        (1e-2, 1e6, 1.0, 0.0, False),  # still far from the minimum, whatever the history says
    ],
)
def test_the_next_step_is_foreseen(decrease, previous, gain_ratio, withheld, converged):
    assert cost_converged(decrease, previous, gain_ratio, withheld, 1e-6) == converged


@pytest.mark.parametrize("seed", range(3))
def test_what_is_left_after_convergence_is_less_than_the_tolerance(seed):
    problem = scene_problem(seed=seed, num_cameras=8, num_points=60, num_lines=10, disturb=0.05, noise=1.0)
    found = solve(problem, SolverOptions(function_tolerance=1e-4)).report
    best = solve(problem, SolverOptions(function_tolerance=0.0, max_iterations=100)).report
    assert found.termination is Termination.COST_CONVERGED
    assert found.iterations < best.iterations
    assert found.final_cost - best.final_cost <= 1e-4 * best.final_cost
    assert np.isfinite(best.final_cost)
