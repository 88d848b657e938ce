"""Whole solves: convergence, robust losses, motion only, structure only."""

import dataclasses

import numpy as np
import pytest
from problems import INTRINSICS, dense_normal_equations, pixels_of, scene_problem

import groma.solver.linear.schur as schur_module
from groma.factors import PointReprojection
from groma.factors.contract import Ref
from groma.factors.losses import Cauchy
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.geometry.manifold import Euclidean
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.solver.options import SolverOptions
from groma.solver.solve import solve
from groma.solver.termination import Termination


@pytest.mark.parametrize("linear_solver", ["dense", "sparse", "pcg"])
def test_reaches_the_noise_floor(linear_solver):
    problem = scene_problem(num_cameras=6, num_points=150, num_lines=40, disturb=0.02)
    options = SolverOptions(linear_solver=linear_solver, function_tolerance=1e-10)
    solution = solve(problem, options)
    report = solution.report
    assert report.converged
    # seven unknowns of the frame do not use up residuals; 2 sigma of the chi-square mean
    redundancy = report.num_residuals - report.num_unknowns + 7
    assert abs(2 * report.final_cost / redundancy - 1) < 2 * np.sqrt(2 / redundancy)
    _, g, _ = dense_normal_equations(solution.problem)
    assert np.abs(g).max() < 1e-2 * np.abs(dense_normal_equations(problem)[1]).max()


def test_same_minimum_from_every_solver():
    problem = scene_problem(num_cameras=6, num_points=60, shared_intrinsics=True)
    costs = [
        solve(problem, SolverOptions(linear_solver=k, function_tolerance=1e-12, max_iterations=100)).report
        for k in ("dense", "sparse", "pcg")
    ]
    np.testing.assert_allclose([r.final_cost for r in costs], costs[0].final_cost, rtol=1e-6)


@pytest.mark.parametrize("chart", ["cartesian", "orthonormal_right", "orthonormal_left", "free_right", "free_left"])
def test_line_charts_reach_the_same_minimum(chart):
    reference = solve(scene_problem(num_points=20, num_lines=30), SolverOptions(function_tolerance=1e-12))
    problem = scene_problem(num_points=20, num_lines=30, line_chart=chart)
    solution = solve(problem, SolverOptions(function_tolerance=1e-12, max_iterations=100))
    np.testing.assert_allclose(solution.report.final_cost, reference.report.final_cost, rtol=1e-6)


def test_far_points_reach_their_depth_in_few_steps(monkeypatch):
    """Rays at small angles say little about depth; the damping that suits the cameras must not hold the points back."""
    rng = np.random.default_rng(0)
    poses = np.tile([0.0, 0, 0, 1, 0, 0, 0], (6, 1))
    poses[:, 4] = -np.linspace(0, 1, 6)
    points = np.hstack([rng.uniform(-0.4, 0.4, (80, 2)), np.ones((80, 1))]) * rng.choice([5.0, 150.0], (80, 1))
    camera, point = np.repeat(np.arange(6), 80), np.tile(np.arange(80), 6)
    seen = PointReprojection(
        pose=Ref("poses", camera),
        point=Ref("points", point),
        intrinsics=Ref("intrinsics", np.zeros(480, int)),
        camera_model="PINHOLE",
        pixels=pixels_of(poses[camera], points[point]) + rng.normal(0, 0.2, (480, 2)),
    )
    held = np.zeros((6, 6), dtype=bool)
    held[0] = held[5, 0] = True
    variables = {
        "poses": Variables(POSE_CHARTS["left"], poses, held),
        "intrinsics": Variables(Euclidean(4, "intrinsics"), INTRINSICS[None], True),
        "points": Variables(Euclidean(3, "point"), points * rng.uniform(0.9, 1.1, (80, 1))),
    }
    problem, options = Problem(variables, [seen]), SolverOptions(function_tolerance=1e-8)
    shared = solve(problem, options).report
    monkeypatch.setattr(schur_module, "LANDMARK_DAMPING", {})
    same = solve(problem, options).report
    np.testing.assert_allclose(shared.final_cost, same.final_cost, rtol=1e-5)
    assert shared.iterations < same.iterations


def test_start_alone_is_evaluated():
    problem = scene_problem(num_lines=5)
    report, full = solve(problem, SolverOptions(max_iterations=0)).report, solve(problem).report
    assert report.termination is Termination.MAX_ITERATIONS
    assert report.initial_cost == report.final_cost == pytest.approx(full.initial_cost, rel=1e-12)
    assert report.final_costs == pytest.approx(full.initial_costs, rel=1e-12)


def test_a_start_that_promises_little_is_kept():
    problem = solve(scene_problem(num_lines=5), SolverOptions(function_tolerance=1e-3)).problem
    step = solve(problem, SolverOptions(max_iterations=1)).report
    promised = (step.initial_cost - step.final_cost) / step.history[0].gain_ratio / step.initial_cost
    assert promised > 0.0
    kept = solve(problem, SolverOptions(start_tolerance=1.01 * promised))
    assert (kept.report.termination, kept.report.iterations) == (Termination.COST_CONVERGED, 0)
    assert kept.report.final_cost == kept.report.initial_cost
    for name, group in problem.variables.items():
        np.testing.assert_array_equal(kept.problem.variables[name].state, group.state)
    moved = solve(problem, SolverOptions(start_tolerance=0.99 * promised)).report
    assert moved.iterations > 0
    assert moved.final_cost < moved.initial_cost


def test_robust_loss_ignores_an_outlier():
    problem = scene_problem(num_cameras=6, num_points=60)
    clean = solve(problem)
    factor = problem.factors[0]
    pixels = factor.pixels.copy()
    pixels[7] += 300.0
    spoiled = Problem(problem.variables, [dataclasses.replace(factor, pixels=pixels, loss=Cauchy(1.0))])
    robust = solve(spoiled)
    plain = solve(Problem(problem.variables, [dataclasses.replace(factor, pixels=pixels)]))

    def error(solution):
        """Distance of the cameras from the clean solution, relative poses only."""
        from groma.geometry import se3

        first = se3.compose(solution["poses"][1:], se3.inverse(solution["poses"][:1]))
        second = se3.compose(clean["poses"][1:], se3.inverse(clean["poses"][:1]))
        return np.abs(se3.log(se3.compose(first, se3.inverse(second)))[:, 3:]).max()

    assert error(robust) < 0.1 * error(plain)


def test_landmark_steps_keep_or_lower_the_cost():
    problem = scene_problem(num_points=20, num_lines=40, loss=Cauchy(1.0), disturb=0.03)
    plain = solve(problem, SolverOptions(max_iterations=6))
    refined = solve(problem, SolverOptions(max_iterations=6, landmark_steps=3))
    assert refined.report.final_cost <= plain.report.final_cost * (1 + 1e-9)


def test_motion_only_and_structure_only_find_the_minimum():
    for fixed in ({"constant_landmarks": True}, {"constant_poses": True}):
        problem = scene_problem(num_points=40, num_lines=20, **fixed)
        solution = solve(problem, SolverOptions(function_tolerance=1e-12))
        assert solution.report.linear_solver == "blocks"
        assert solution.report.converged
        H, g, _ = dense_normal_equations(solution.problem)
        newton = np.linalg.lstsq(H, -g, rcond=1e-12)[0]
        assert np.abs(newton).max() < 1e-5


def test_nothing_is_changed_in_place():
    problem = scene_problem(num_lines=5)
    before = {name: group.state.copy() for name, group in problem.variables.items()}
    solve(problem)
    for name, state in before.items():
        np.testing.assert_array_equal(problem.variables[name].state, state)


def test_progress_can_stop():
    seen = []
    solution = solve(scene_problem(disturb=0.05), progress=lambda record: seen.append(record) or len(seen) < 2)
    assert len(seen) == 2
    assert solution.report.termination is Termination.STOPPED_BY_CALLER
