# SPDX-License-Identifier: BSD-3-Clause
"""When the cost counts as converged: taken from what the next step would bring, and never too early."""

import dataclasses

import numpy as np
import pytest
from problems import scene_problem

from groma.problem.problem import Problem
from groma.solver.covariance.marginals import Covariances
from groma.solver.damped_problem import Trial
from groma.solver.options import SolverOptions
from groma.solver.solve import solve
from groma.solver.termination import Termination, cost_converged, is_beyond_cost


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


@pytest.mark.kernels
@pytest.mark.compiled
def test_the_last_step_goes_where_the_cost_cannot_tell():
    """From two starts the same states to the rounding of the gradient, which the cost knows to half of its digits."""
    problem = scene_problem(num_cameras=6, num_points=60, num_lines=8, noise=1.0, disturb=0.01)
    poses = dataclasses.replace(problem.variables["poses"], constant=np.arange(6) < 2)
    problem = Problem({**problem.variables, "poses": poses}, problem.factors)
    exact = {"method": "gauss_newton", "function_tolerance": 0.0, "gradient_tolerance": 0.0, "step_tolerance": 0.0}
    one = solve(problem, SolverOptions(**exact))
    rng = np.random.default_rng(8)
    points = problem.variables["points"]
    moved = dataclasses.replace(points, state=points.state + 1e-3 * rng.normal(size=points.state.shape))
    two = solve(Problem({**problem.variables, "points": moved}, problem.factors), SolverOptions(**exact))
    told = np.sqrt(2.0 * np.finfo(float).eps * one.report.final_cost)  # standard deviations
    sigma = Covariances(one.problem)
    for name in ("poses", "points", "lines"):
        off = one.problem.variables[name].manifold.local(one[name], two[name])
        deviation = np.sqrt(np.maximum(np.einsum("nii->ni", sigma.of(name)), 1e-300))
        free = deviation > 1e-100
        assert np.abs(off[free] / deviation[free]).max() < 1e-3 * told, name


@pytest.mark.parametrize(
    ("promised", "cost", "num_hidden", "beyond"),
    [(1e-15, 1.0, 0, True), (1e-15, 1.0 + 5e-14, 0, True), (1e-13, 1.0, 0, False), (1e-15, 1.0 + 2e-13, 0, False),
     (1e-15, np.nan, 0, False), (1e-15, 1.0, 1, False)],
)  # fmt: skip
def test_steps_that_the_cost_cannot_judge(promised, cost, num_hidden, beyond):
    assert is_beyond_cost(Trial(cost, num_hidden, promised=promised), Trial(1.0)) == beyond
