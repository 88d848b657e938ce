"""Solves in shards: the same minimum as at once, however landmarks are cut; merged blocks; what is held; odd cases."""

import dataclasses
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from problems import scene_problem

import groma.solver.reduce.shards as shards_module
from groma.errors import ProblemError
from groma.factors.contract import Ref
from groma.factors.losses import Cauchy
from groma.problem.problem import Problem
from groma.solver.options import SolverOptions
from groma.solver.reduce.shards import Shard, solve_shards
from groma.solver.solve import solve
from groma.solver.termination import Termination

pytestmark = pytest.mark.kernels
TIGHT = SolverOptions(function_tolerance=1e-10, max_iterations=100, threads=1)


def cut(problem, count):
    """Shards with about as many landmarks each; factors without a landmark go to the first."""
    groups = [name for name, group in problem.variables.items() if group.manifold.kind in ("point", "line")]
    ends = {name: np.linspace(0, len(problem.variables[name]), count + 1).astype(int) for name in groups}

    def shard(number):
        rows = {name: slice(int(ends[name][number]), int(ends[name][number + 1])) for name in groups}

        def factors():
            made = [part(factor, rows, number) for factor in problem.factors]
            return [factor for factor in made if factor is not None]

        return Shard(rows, factors)

    return [shard(number) for number in range(count)]


def part(factor, rows, number):
    landmark = [ref for _, ref in factor.references() if ref.group in rows]
    if not landmark:
        return factor if number == 0 else None
    own = rows[landmark[0].group]
    take = np.flatnonzero((landmark[0].index >= own.start) & (landmark[0].index < own.stop))
    values = {}
    for field in dataclasses.fields(factor):
        value = getattr(factor, field.name)
        if isinstance(value, Ref):
            value = Ref(value.group, value.index[take] - (own.start if value.group in rows else 0))
        elif isinstance(value, np.ndarray) and value.ndim and len(value) == len(factor):
            value = value[take]
        values[field.name] = value
    return type(factor)(**values) if len(take) else None


# Private principal points are hardly determined here; conjugate gradients need hundreds of steps, in shards or not.
@pytest.mark.parametrize(
    ("shared_intrinsics", "linear_solver"),
    [(None, "dense"), (None, "pcg"), (True, "sparse"), (True, "pcg"), (False, "dense"), (False, "sparse")],
)
def test_reaches_the_minimum_of_the_whole(shared_intrinsics, linear_solver):
    problem = scene_problem(num_cameras=6, num_points=200, num_lines=20, views=6, shared_intrinsics=shared_intrinsics)
    whole = solve(problem, TIGHT)
    options = dataclasses.replace(TIGHT, linear_solver=linear_solver)
    for count in (1, 4):
        parts = solve_shards(problem.variables, cut(problem, count), options)
        assert parts.report.converged and parts.report.linear_solver == linear_solver
        assert parts.report.num_residuals == whole.report.num_residuals
        assert parts.report.num_unknowns == whole.report.num_unknowns
        np.testing.assert_allclose(parts.report.initial_cost, whole.report.initial_cost, rtol=1e-12)
        np.testing.assert_allclose(parts.report.final_cost, whole.report.final_cost, rtol=1e-7)
        states = {name: group.state for name, group in parts.variables.items()}
        again = solve(problem.with_states(states), SolverOptions(max_iterations=0))
        np.testing.assert_allclose(again.report.initial_cost, parts.report.final_cost, rtol=1e-12)


def test_cuts_make_no_difference_to_a_step():
    problem = scene_problem(num_cameras=6, num_points=60, num_lines=20, shared_intrinsics=False)
    one_step = SolverOptions(max_iterations=1, linear_solver="dense", threads=1)
    first, *others = [solve_shards(problem.variables, cut(problem, count), one_step) for count in (1, 2, 7)]
    assert first.report.history[0].accepted
    for other in others:
        np.testing.assert_allclose(other.report.history[0].gain_ratio, first.report.history[0].gain_ratio, rtol=1e-6)
        for name, group in first.variables.items():
            np.testing.assert_allclose(other.variables[name].state, group.state, rtol=0, atol=1e-8)


def test_the_step_is_that_of_a_solve_at_once():
    problem = scene_problem(num_cameras=6, num_points=60)
    options = SolverOptions(max_iterations=1, linear_solver="dense", threads=1, initial_damping=1e-4)
    whole, parts = solve(problem, options), solve_shards(problem.variables, cut(problem, 3), options)
    for key in ("cost", "gain_ratio", "step_norm"):
        expected = getattr(whole.report.history[0], key)
        np.testing.assert_allclose(getattr(parts.report.history[0], key), expected, rtol=1e-6)


def test_refused_steps_are_undone():
    problem = scene_problem(num_cameras=6, num_points=60, disturb=0.6)
    report = solve_shards(
        problem.variables, cut(problem, 3), dataclasses.replace(TIGHT, initial_damping=1e-12, max_iterations=200)
    ).report
    refused = [record for record in report.history if not record.accepted]
    assert refused, "the start is meant to be too far for undamped steps"
    costs = [record.cost for record in report.history if record.accepted]
    assert (np.diff(costs) < 0).all()
    assert costs[-1] == report.final_cost


def test_what_is_constant_does_not_move():
    problem = scene_problem(num_cameras=6, num_points=60)
    variables = dict(problem.variables)
    poses = next(name for name, group in variables.items() if group.manifold.kind == "pose")
    points = next(name for name, group in variables.items() if group.manifold.kind == "point")
    held_pose, held_point = np.zeros(len(variables[poses]), bool), np.zeros(len(variables[points]), bool)
    held_pose[2] = held_point[[5, 40]] = True
    variables[poses] = dataclasses.replace(variables[poses], constant=held_pose)
    variables[points] = dataclasses.replace(variables[points], constant=held_point)
    problem = Problem(variables, problem.factors)
    solution = solve_shards(variables, cut(problem, 3), TIGHT)
    np.testing.assert_allclose(solution.report.final_cost, solve(problem, TIGHT).report.final_cost, rtol=1e-7)
    np.testing.assert_array_equal(solution.variables[poses].state[2], variables[poses].state[2])
    np.testing.assert_array_equal(solution.variables[points].state[held_point], variables[points].state[held_point])


def test_stops_when_asked():
    problem = scene_problem(num_cameras=6, num_points=60, disturb=0.02)
    seen = []

    def progress(record):
        seen.append(record.iteration)
        return record.iteration < 2

    solution = solve_shards(problem.variables, cut(problem, 2), TIGHT, progress)
    assert seen == [1, 2]
    assert solution.report.termination is Termination.STOPPED_BY_CALLER
    assert solution.report.final_cost < solution.report.initial_cost


def test_says_what_is_wrong_with_shards():
    problem = scene_problem(num_cameras=6, num_points=60)
    shards = cut(problem, 2)
    with pytest.raises(ProblemError, match="no shards"):
        solve_shards(problem.variables, [])
    with pytest.raises(ProblemError, match="is in 0"):
        solve_shards(problem.variables, shards[:1])
    with pytest.raises(ProblemError, match="is in 2"):
        solve_shards(problem.variables, [*shards, shards[0]])
    with pytest.raises(ProblemError, match="names the group 'trees'"):
        solve_shards(problem.variables, [Shard({"trees": slice(0, 1)}, list)])


def test_steps_are_longer_under_a_robust_loss(monkeypatch):
    """Reweighted least squares overestimates the curvature; a step learns that from the one before."""
    problem = scene_problem(num_cameras=6, num_points=80, loss=Cauchy(1.0))
    long = solve_shards(problem.variables, cut(problem, 3), TIGHT).report
    monkeypatch.setattr(shards_module, "MAX_STRETCH", 1.0)
    short = solve_shards(problem.variables, cut(problem, 3), TIGHT).report
    visits = [sum(1 if record.accepted else 2 for record in report.history) for report in (long, short)]
    assert visits[0] < 0.7 * visits[1]
    np.testing.assert_allclose(long.final_cost, short.final_cost, rtol=1e-4)


class Together:
    """The reducer of several threads that play machines."""

    def __init__(self, count):
        self._barrier, self._given, self._count = threading.Barrier(count), {}, count
        self.own = threading.local()

    def _gather(self, values):
        self._given[self.own.number] = values
        self._barrier.wait(60)
        found = [self._given[number] for number in range(self._count)]
        self._barrier.wait(60)
        return found

    def sum(self, values):
        return np.sum(self._gather(values), axis=0)

    def union(self, numbers):
        return np.unique(np.concatenate(self._gather(numbers)))


def test_machines_with_shards_of_their_own_solve_one_problem():
    problem = scene_problem(num_cameras=6, num_points=60, num_lines=20, shared_intrinsics=True)
    shards = cut(problem, 4)
    alone = solve_shards(problem.variables, shards, TIGHT)
    reducer = Together(2)

    def work(number):
        reducer.own.number = number
        return solve_shards(problem.variables, shards[number::2], TIGHT, reducer=reducer)

    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(work, range(2))
    for name in ("poses", "intrinsics"):
        np.testing.assert_array_equal(first.variables[name].state, second.variables[name].state)
    assert first.report.num_residuals == alone.report.num_residuals
    np.testing.assert_allclose(first.report.final_cost, alone.report.final_cost, rtol=1e-9)
    rows = shards[1].landmarks["points"]
    np.testing.assert_array_equal(first.variables["points"].state[rows], problem.variables["points"].state[rows])
    assert np.abs(second.variables["points"].state[rows] - problem.variables["points"].state[rows]).min() > 0


def test_gauss_newton_in_shards():
    problem = scene_problem(num_cameras=6, num_points=60, noise=0.1, disturb=1e-3)
    held = np.zeros(6, bool)
    held[:2] = True
    variables = {**problem.variables, "poses": dataclasses.replace(problem.variables["poses"], constant=held)}
    options = dataclasses.replace(TIGHT, method="gauss_newton")
    report = solve_shards(variables, cut(problem, 3), options).report
    assert report.converged and report.iterations <= 5
    assert solve_shards(problem.variables, cut(problem, 3), options).report.termination is Termination.SINGULAR
