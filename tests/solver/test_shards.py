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
from groma.solver.reduce import exact_sums
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
@pytest.mark.compiled
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


@pytest.mark.compiled
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


@pytest.mark.compiled
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


@pytest.mark.compiled
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
    """The reducer of several threads that play processes."""

    def __init__(self, count):
        self._barrier, self._given, self.size = threading.Barrier(count), {}, count
        self.num_neighbours, self.num_cores = count, 1
        self._own = threading.local()

    @property
    def rank(self):
        return self._own.number

    def play(self, number):
        self._own.number = number

    def _gather(self, values):
        self._given[self.rank] = values
        self._barrier.wait(60)
        found = [self._given[number] for number in range(self.size)]
        self._barrier.wait(60)
        return found

    def sum(self, values):
        total, *others = self._gather(values.copy())[:: -1 if self.rank else 1]
        total = total.copy()
        for other in others:
            exact_sums.add_sums(total, other)
        return total

    def union(self, numbers):
        return np.unique(np.concatenate(self._gather(numbers)))

    def gather(self, text):
        return self._gather(text)


def of_process(problem, shards):
    """The variables of a process with some of the shards, and these: landmarks of others it does not have."""
    names = shards[0].landmarks if shards else ()
    variables = {
        name: group for name, group in problem.variables.items() if group.manifold.kind not in ("point", "line")
    }
    own = [{} for _ in shards]
    for name in names:
        rows = [shard.landmarks[name] for shard in shards]
        group = problem.variables[name]
        variables[name] = group.with_state(np.concatenate([group.state[part] for part in rows]))
        ends = np.cumsum([0] + [part.stop - part.start for part in rows])
        for number in range(len(shards)):
            own[number][name] = slice(int(ends[number]), int(ends[number + 1]))
    return variables, [Shard(rows, shard.factors) for rows, shard in zip(own, shards, strict=True)]


@pytest.mark.compiled
@pytest.mark.parametrize("linear_solver", ["dense", "pcg"])
@pytest.mark.parametrize("count", [2, 5])
def test_processes_with_shards_of_their_own_find_the_same_bits(count, linear_solver):
    """Five processes for four shards: one has none, and sums with the others."""
    problem = scene_problem(num_cameras=6, num_points=60, num_lines=20, shared_intrinsics=True)
    shards, options = cut(problem, 4), dataclasses.replace(TIGHT, linear_solver=linear_solver)
    alone = solve_shards(problem.variables, shards, options)
    reducer = Together(count)

    def work(number):
        reducer.play(number)
        variables, own = of_process(problem, shards[number::count])
        return solve_shards(variables, own, options, reducer=reducer, room=1e9 if number == 0 else 0.0)

    with ThreadPoolExecutor(count) as pool:
        found = list(pool.map(work, range(count)))
    for number, solution in enumerate(found):
        assert solution.report.final_cost == alone.report.final_cost
        assert solution.report.num_residuals == alone.report.num_residuals
        assert solution.report.num_unknowns == alone.report.num_unknowns
        for name, group in solution.variables.items():
            whole = alone.variables[name].state
            if name in shards[0].landmarks:
                whole = np.concatenate([whole[shard.landmarks[name]] for shard in shards[number::count]])
            np.testing.assert_array_equal(group.state, whole)


class Diary:
    """Keeps all waypoints."""

    def __init__(self, begin=None):
        self.begin, self.kept = begin, []

    def keep(self, states, waypoint):
        self.kept.append(({name: state.copy() for name, state in states.items()}, waypoint))


@pytest.mark.compiled
@pytest.mark.parametrize("room", [0.0, 1e9])
def test_goes_on_where_it_stood(room):
    """From every accepted step on a solve comes to the same bits, whether shards stay in memory or not."""
    problem = scene_problem(num_cameras=6, num_points=60, disturb=0.6)
    options = dataclasses.replace(TIGHT, initial_damping=1e-12, max_iterations=200)
    shards, diary, calls = cut(problem, 3), Diary(), []
    counted = [Shard(shard.landmarks, lambda shard=shard: calls.append(1) or shard.factors()) for shard in shards]
    whole = solve_shards(problem.variables, counted, options, journal=diary, room=room)
    assert len(calls) == 3 if room else len(calls) > 3 * whole.report.iterations
    assert len(diary.kept) > 4 and any(not record.accepted for record in whole.report.history)
    assert diary.kept[-1][1].standing.ended is whole.report.termination
    for states, waypoint in diary.kept[::5] + diary.kept[-1:]:
        variables = problem.with_states(states).variables
        again = solve_shards(variables, shards, options, journal=Diary(waypoint))
        assert again.report.iterations == whole.report.iterations
        assert again.report.initial_cost == whole.report.initial_cost
        assert again.report.termination is whole.report.termination
        for name, group in whole.variables.items():
            np.testing.assert_array_equal(again.variables[name].state, group.state)


def test_shards_are_the_same_at_every_visit():
    problem = scene_problem(num_cameras=6, num_points=60)
    few, all_of_them = cut(problem, 1)[0].factors, iter([True])

    def factors():
        if next(all_of_them, False):
            return [dataclasses.replace(f, **first_rows(f)) for f in few()]
        return few()

    def first_rows(factor):
        row = {f.name: getattr(factor, f.name) for f in dataclasses.fields(factor)}
        take = np.flatnonzero(next(ref.index for _, ref in factor.references() if ref.group == "poses") < 2)
        return {
            name: Ref(value.group, value.index[take]) if isinstance(value, Ref) else value[take]
            for name, value in row.items()
            if isinstance(value, Ref) or (isinstance(value, np.ndarray) and value.ndim and len(value) == len(factor))
        }

    with pytest.raises(ProblemError, match="same factors every time"):
        solve_shards(problem.variables, [Shard(cut(problem, 1)[0].landmarks, factors)], TIGHT)


def test_gauss_newton_in_shards():
    problem = scene_problem(num_cameras=6, num_points=60, noise=0.1, disturb=1e-3)
    held = np.zeros(6, bool)
    held[:2] = True
    variables = {**problem.variables, "poses": dataclasses.replace(problem.variables["poses"], constant=held)}
    options = dataclasses.replace(TIGHT, method="gauss_newton")
    report = solve_shards(variables, cut(problem, 3), options).report
    assert report.converged and report.iterations <= 5
    assert solve_shards(problem.variables, cut(problem, 3), options).report.termination is Termination.SINGULAR
