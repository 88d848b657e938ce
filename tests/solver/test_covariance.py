"""Marginal covariances against the inverse of the full normal matrix, held and inner gauge, and rank deficiency."""

import dataclasses

import numpy as np
import pytest
from problems import dense_normal_equations, scene_problem

from groma.errors import ProblemError
from groma.problem.problem import Problem
from groma.solver.covariance import Covariances
from groma.solver.options import SolverOptions
from groma.solver.solve import solve


def held(problem):
    """Hold the first pose and one coordinate of the second."""
    constant = np.zeros((len(problem.variables["poses"]), 6), dtype=bool)
    constant[0] = True
    constant[1, 2] = True
    variables = dict(problem.variables)
    variables["poses"] = dataclasses.replace(variables["poses"], constant=constant)
    return Problem(variables, problem.factors)


def full_covariance(problem, keep=None):
    H, _, columns = dense_normal_equations(problem)
    free = np.diag(H) > 0
    C = np.zeros_like(H)
    C[np.ix_(free, free)] = np.linalg.inv(H[np.ix_(free, free)])
    return C, columns


@pytest.mark.parametrize(
    "case", [{}, {"num_lines": 8}, {"num_lines": 8, "num_planes": 1}, {"shared_intrinsics": True, "num_points": 60}]
)
def test_equals_inverse_of_full_matrix(case):
    problem = solve(held(scene_problem(**case)), SolverOptions(function_tolerance=1e-12)).problem
    covariances = Covariances(problem)
    expected, columns = full_covariance(problem)
    for name, (first, dof) in columns.items():
        got = covariances.of(name)
        for k in range(len(problem.variables[name])):
            block = expected[first + k * dof : first + (k + 1) * dof, first + k * dof : first + (k + 1) * dof]
            np.testing.assert_allclose(got[k], block, atol=1e-6 * np.abs(block).max(), rtol=1e-6)


def test_inner_gauge_is_the_pseudo_inverse_of_the_cameras():
    problem = solve(scene_problem(num_points=40), SolverOptions(function_tolerance=1e-12)).problem
    covariances = Covariances(problem, gauge="inner")
    H, _, columns = dense_normal_equations(problem)
    first, dof = columns["poses"]
    size = len(problem.variables["poses"]) * dof
    points, point_dof = columns["points"]
    stop = points + len(problem.variables["points"]) * point_dof
    W = H[first : first + size, points:stop]
    S = H[first : first + size, first : first + size] - W @ np.linalg.solve(H[points:stop, points:stop], W.T)
    expected = np.linalg.pinv(S, rcond=1e-10, hermitian=True)
    got = covariances.of("poses")
    for k in range(len(got)):
        block = expected[k * dof : (k + 1) * dof, k * dof : (k + 1) * dof]
        np.testing.assert_allclose(got[k], block, atol=1e-5 * np.abs(block).max())


def test_free_scene_is_refused_with_the_remedy():
    with pytest.raises(ProblemError, match=r"rank deficient by 7.*gauge='inner'"):
        Covariances(scene_problem(num_points=40))


def test_structure_only():
    problem = scene_problem(num_points=20, constant_poses=True)
    covariances = Covariances(problem)
    expected, _columns = full_covariance(problem)
    got = covariances.of("points")
    for k in range(20):
        block = expected[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        np.testing.assert_allclose(got[k], block, rtol=1e-8, atol=1e-10 * np.abs(block).max())
