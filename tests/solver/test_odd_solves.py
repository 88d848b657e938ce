"""Solves at the edge: nothing to solve, numbers that are none, unusual orders and sizes."""

import dataclasses

import numpy as np
import pytest
from problems import dense_normal_equations, scene_problem

import groma.problem.lay_out as lay_out_module
import groma.solver.joint as joint_module
from groma.errors import InputError, ProblemError
from groma.factors import PointOnLine, PointReprojection, VectorPrior
from groma.factors.contract import Example, Factor, Ref, Slot
from groma.factors.losses import Cauchy, Truncated
from groma.geometry.manifold import Euclidean
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.solver.options import SolverOptions
from groma.solver.solve import solve
from groma.solver.termination import Termination


def test_empty_problem_and_everything_constant():
    assert solve(Problem({}, [])).report.termination is Termination.NOTHING_TO_DO
    problem = scene_problem(constant_poses=True, constant_landmarks=True)
    assert solve(problem).report.termination is Termination.NOTHING_TO_DO


def test_held_variables_keep_their_last_bits():
    """A step of zero rounds a quaternion that is of unit length up to rounding."""
    problem = scene_problem(num_cameras=60, num_points=120)
    poses, held = problem.variables["poses"], np.arange(60) % 3 > 0
    variables = {**problem.variables, "poses": dataclasses.replace(poses, constant=held)}
    found = solve(Problem(variables, problem.factors)).problem.variables["poses"].state
    assert np.array_equal(found[held], poses.state[held])
    assert (found[~held] != poses.state[~held]).any(axis=1).all()


def test_empty_groups_are_ignored():
    problem = scene_problem(num_points=20)
    empty = problem.factors[0].take(np.zeros(0, dtype=int))
    variables = {**problem.variables, "nobody": Variables(Euclidean(3, "point"), np.zeros((0, 3)))}
    solution = solve(Problem(variables, [*problem.factors, empty]))
    assert solution.report.converged


def test_one_camera_one_point():
    problem = scene_problem(num_cameras=1, num_points=1, views=1)
    report = solve(problem).report
    assert report.final_cost < 1e-6
    assert not report.warnings  # 2 residuals of 9 unknowns, and 7 are the position, rotation and scale of the world
    report = solve(scene_problem(num_cameras=1, num_points=2, views=1)).report
    assert any("fewer residuals" in warning for warning in report.warnings)


def test_factor_between_eliminated_landmarks_is_refused_or_kept():
    problem = scene_problem(num_points=20, num_lines=10)
    link = PointOnLine(point=Ref("points", np.arange(3)), line=Ref("lines", np.arange(3)), sqrt_information=0.1)
    coupled = Problem(problem.variables, [*problem.factors, link])
    with pytest.raises(ProblemError, match=r"couples two eliminated landmarks.*eliminate=\('points',\)"):
        solve(coupled, SolverOptions(eliminate=("points", "lines")))
    report = solve(coupled).report
    assert report.converged
    assert any("stays in the reduced system" in note for note in report.notes)


def test_landmark_without_information_stays():
    """All observations of a point lie beyond a truncated loss: its weight is zero, it must not move or spoil others."""
    problem = scene_problem(num_points=30, loss=Truncated(20.0))
    factor = problem.factors[0]
    pixels = factor.pixels.copy()
    pixels[factor.point.index == 3] += 5000.0
    spoiled = Problem(problem.variables, [dataclasses.replace(factor, pixels=pixels)])
    solution = solve(spoiled)
    assert np.isfinite(solution["points"]).all()
    np.testing.assert_array_equal(solution["points"][3], problem.variables["points"].state[3])
    assert solution.report.num_underdetermined_landmarks == 1
    assert any("unobservable direction" in warning for warning in solution.report.warnings)


@pytest.mark.parametrize("constant_poses", [False, True])
def test_landmarks_that_are_held_are_not_called_unobservable(constant_poses):
    """Whole points and single coordinates of them, in a joint solve and where every point is a problem of its own."""
    problem = scene_problem(num_points=30, constant_poses=constant_poses)
    held = np.zeros((30, 3), bool)
    held[:4], held[7, 1] = True, True
    points = dataclasses.replace(problem.variables["points"], constant=held)
    report = solve(Problem({**problem.variables, "points": points}, problem.factors)).report
    assert report.num_underdetermined_landmarks == 0 and report.warnings == []


def test_not_finite_start_is_an_outcome():
    problem = scene_problem(num_points=10)
    factor = dataclasses.replace(problem.factors[0], sqrt_information=1e200)
    report = solve(Problem(problem.variables, [factor])).report
    assert report.termination is Termination.NOT_FINITE


def _spoiled(problem: Problem, row: int, value: float) -> PointReprojection:
    pixels = problem.factors[0].pixels.copy()
    pixels[row, 1] = value
    return dataclasses.replace(problem.factors[0], pixels=pixels)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_measurements_that_are_no_numbers_are_refused_by_name(value):
    problem = scene_problem(num_points=10)
    with pytest.raises(InputError, match=r"PointReprojection\.pixels must be finite; row 7"):
        _spoiled(problem, 7, value)
    prior = VectorPrior(variable=Ref("points", np.arange(8)), measured=np.array(8 * [[1.0, 2.0, 3.0]]))
    prior.measured[5, 1] = value
    with pytest.raises(ProblemError, match=r"Factor 5 of 'vector_prior' .* measured is .*\(variable -> points 5\)"):
        Problem(problem.variables, [prior])
    for noise in (value, np.where(np.arange(len(problem.factors[0])) == 3, value, 1.0)):
        with pytest.raises(ProblemError, match="of 'point_reprojection' needs finite numbers; its sqrt_information"):
            Problem(problem.variables, [dataclasses.replace(problem.factors[0], sqrt_information=noise)])
    Problem(problem.variables, [_spoiled(problem, 7, 1e308), _spoiled(problem, 8, 1.7e308)])  # large, but numbers


@pytest.mark.parametrize("focal", [0.0, -800.0])
def test_focal_lengths_that_are_not_positive_are_refused_by_name(focal):
    problem = scene_problem(num_points=10, shared_intrinsics=False)
    parameters = problem.variables["intrinsics"].state.copy()
    parameters[2, 1] = focal
    variables = {**problem.variables, "intrinsics": problem.variables["intrinsics"].with_state(parameters)}
    with pytest.raises(
        ProblemError, match=r"Slot 'intrinsics' .* positive focal lengths; those of variable 2 of group"
    ):
        Problem(variables, problem.factors)


@pytest.mark.parametrize("held", [False, True])
def test_a_solve_in_which_no_factor_counts_has_not_converged(held):
    """Behind all cameras, with no weight, or beyond a loss that rejects them: a cost that nothing changes."""
    problem = scene_problem(num_points=10, constant_poses=held)
    (factor,) = problem.factors
    R, t = np.split(problem.variables["poses"].ambient()[0].reshape(3, 4), [3], axis=1)
    back = R.T @ (np.array([[0.1], [0.2], [-5.0]]) - t)  # behind the first camera, which alone looks
    one = dataclasses.replace(factor.take(np.flatnonzero(factor.pose.index == 0)), require_in_front=True)
    behind = Problem(problem.with_states({"points": np.tile(back.T, (10, 1))}).variables, [one])
    weightless = Problem(problem.variables, [dataclasses.replace(factor, sqrt_information=0.0)])
    rejected = Problem(
        problem.variables, [dataclasses.replace(factor, pixels=factor.pixels + 1e6, loss=Truncated(1.0))]
    )
    for spoiled in (weightless, rejected, behind):
        report = solve(spoiled).report
        assert report.termination is Termination.NO_FACTOR_COUNTS and not report.converged
    assert solve(behind, SolverOptions(max_iterations=0)).report.termination is Termination.NO_FACTOR_COUNTS


def test_unknown_group_and_bad_index_are_refused():
    problem = scene_problem(num_points=10)
    with pytest.raises(ProblemError, match="has the groups"):
        Problem({"poses": problem.variables["poses"]}, problem.factors)
    bad = dataclasses.replace(problem.factors[0], point=Ref("points", problem.factors[0].point.index + 5))
    with pytest.raises(ProblemError, match="which has 10"):
        Problem(problem.variables, [bad])
    with pytest.raises(ProblemError, match="takes variables of kind"):
        Problem({**problem.variables, "points": problem.variables["poses"]}, problem.factors)


def test_prior_alone_is_solved():
    state = np.zeros((4, 2))
    prior = VectorPrior(variable=Ref("x", np.arange(4)), measured=np.arange(8.0).reshape(4, 2))
    solution = solve(Problem({"x": Variables(Euclidean(2), state)}, [prior]), SolverOptions(function_tolerance=1e-14))
    np.testing.assert_allclose(solution["x"], np.arange(8.0).reshape(4, 2), atol=1e-6)


def test_refused_steps_are_not_convergence():
    """Far from the minimum of a bent problem the first steps are refused; the solve must go on until it is there."""
    problem = scene_problem(num_points=40, num_lines=0, constant_landmarks=True, disturb=0.25, num_cameras=8)
    solution = solve(problem, SolverOptions(initial_damping=1e-12, function_tolerance=1e-9, max_iterations=200))
    assert solution.report.converged
    close = solve(scene_problem(num_points=40, constant_landmarks=True, disturb=0.0, num_cameras=8))
    np.testing.assert_allclose(solution.report.final_cost, close.report.final_cost, rtol=1e-5)


def test_points_are_not_hidden_behind_the_camera():
    """A point behind its camera is degenerate and costs nothing; the solver must not gain by moving points there."""
    problem = scene_problem(num_points=30, num_cameras=6, noise=1.0)
    factor = dataclasses.replace(problem.factors[0], pixels=problem.factors[0].pixels * 1.0)
    pixels = factor.pixels.copy()
    pixels[factor.point.index < 5] += np.random.default_rng(0).uniform(-400, 400, pixels[factor.point.index < 5].shape)
    spoiled = Problem(problem.variables, [dataclasses.replace(factor, pixels=pixels, require_in_front=True)])
    solution = solve(spoiled)
    assert solution.report.num_degenerate.get("point_reprojection", 0) <= 2


def test_single_precision_blocks_reach_the_same_minimum(monkeypatch):
    problem = scene_problem(num_lines=6, disturb=0.05)  # far enough that steps are refused
    options = SolverOptions(function_tolerance=1e-12, max_iterations=100)
    plain = solve(problem, options).report
    monkeypatch.setattr(joint_module, "COMPACT_FROM", 0)
    compact = solve(problem, options).report
    assert compact.final_cost == pytest.approx(plain.final_cost, rel=1e-9)


def test_what_a_landmark_becomes_does_not_depend_on_the_others():
    problem = scene_problem(constant_poses=True, num_points=30, disturb=0.05)
    (factor,) = problem.factors
    few = factor.take(np.flatnonzero(factor.point.index < 10))
    options = SolverOptions(gradient_tolerance=0.0)
    together, alone = (solve(Problem(problem.variables, [f]), options)["points"] for f in (factor, few))
    np.testing.assert_allclose(together[:10], alone[:10], rtol=1e-12)
    np.testing.assert_array_equal(alone[10:], problem.variables["points"].state[10:])


@pytest.mark.parametrize("size", [1, 3, 4096])
def test_what_a_landmark_becomes_does_not_depend_on_the_chunks(size, monkeypatch):
    """Chunks with a landmark that has not converged are done in runs; whatever their size, all bits are the same."""
    problem = scene_problem(constant_poses=True, num_points=30, num_lines=8, disturb=0.05)
    expected = solve(problem)
    monkeypatch.setattr(lay_out_module, "CHUNK_ALONE", size)
    found = solve(problem)
    assert found.report.iterations == expected.report.iterations > 2
    for name in ("points", "lines"):
        np.testing.assert_array_equal(found[name], expected[name])


def test_a_layout_serves_other_states_and_losses_alone(monkeypatch):
    """A second solve with the same layouts gives the same bits as one without, and other factors are laid out anew."""
    laid_out = []
    lay_out = lay_out_module.lay_out
    monkeypatch.setattr(lay_out_module, "lay_out", lambda *given: laid_out.append(given) or lay_out(*given))
    options = SolverOptions(landmark_steps=1)
    problem = scene_problem(num_lines=8, disturb=0.03)
    layouts = lay_out_module.Layouts()
    first = solve(problem, options, layouts=layouts).problem
    assert len(laid_out) == 2  # of all, and of the landmarks that take steps of their own
    other = first.with_losses([Cauchy(0.5)] * len(first.factors))
    again = solve(other, options, layouts=layouts)
    assert len(laid_out) == 2
    anew = solve(other, options)
    for name in ("poses", "points", "lines"):
        np.testing.assert_array_equal(again[name], anew[name])
    assert again.report.initial_costs == anew.report.initial_costs
    held = {**other.variables, "poses": dataclasses.replace(other.variables["poses"], constant=True)}
    fewer = Problem(other.variables, [factor.take(np.arange(len(factor) - 1)) for factor in other.factors])
    for changed in (Problem(held, other.factors), fewer):
        before = len(laid_out)
        found, wanted = solve(changed, options, layouts=layouts), solve(changed, options)
        assert len(laid_out) > before + 1
        np.testing.assert_array_equal(found["points"], wanted["points"])


@pytest.mark.parametrize("held", [False, True])
def test_the_gradient_that_is_told_is_the_largest(held):
    """Each component over the root of its diagonal entry of the normal equations, from a dense Jacobian."""
    problem = scene_problem(num_lines=4, disturb=0.03, constant_poses=held)
    H, g, _ = dense_normal_equations(problem)
    expected = float(np.max(np.abs(g) / np.sqrt(np.diag(H))))
    told = solve(problem, SolverOptions(max_iterations=1)).report.history[0].gradient_max
    assert told == pytest.approx(expected, rel=1e-9)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Bowl(Factor):
    """r = (x, 3 + x^2 / 2): at zero the curvature is 4, and Gauss-Newton takes it for 1."""

    variable: Ref
    slots = (Slot("variable", "vector"),)
    type_name = "bowl"

    @property
    def residual_size(self) -> int:
        return 2

    def linearize(self, inputs, begin, end, columns, record):
        x = inputs[0][self.variable.index[begin:end], 0]
        if columns[0] >= 0:
            record[:, :, columns[0]] = np.stack([np.ones_like(x), x], axis=1)
        record[:, :, -1] = np.stack([x, 3.0 + 0.5 * x**2], axis=1)
        return 0

    @classmethod
    def example(cls, rng) -> Example:
        factor = cls(variable=Ref("x", np.arange(3)))
        return Example(factor, {"x": (Euclidean(1), rng.normal(size=(3, 1)))})


def test_a_variable_does_not_jump_over_its_minimum_for_ever():
    """Full steps treble the distance from the minimum. They are shortened by what the first one finds."""
    x = np.array([[0.1], [0.2], [-0.3]])
    problem = Problem({"x": Variables(Euclidean(1), x)}, [_Bowl(variable=Ref("x", np.arange(3)))])
    solution = solve(problem, SolverOptions(initial_damping=1e-6, function_tolerance=1e-9))
    np.testing.assert_allclose(solution["x"], 0.0, atol=1e-4)
    assert solution.report.iterations <= 6
