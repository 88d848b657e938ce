"""The eliminated step equals the dense step, for every mix of variables, chart and linear solver."""

import numpy as np
import pytest
from problems import dense_normal_equations, scene_problem

from groma._stopwatch import Stopwatch
from groma.factors.losses import Cauchy
from groma.problem import linearization, parallel
from groma.problem.lay_out import lay_out
from groma.problem.linearization import NormalEquations, to_solver_order
from groma.problem.parallel import Workers
from groma.solver.joint import JointProblem
from groma.solver.linear.choice import linear_solver
from groma.solver.linear.schur import LANDMARK_DAMPING, MIN_DIAGONAL, ReducedSystem
from groma.solver.options import SolverOptions
from groma.solver.report import SolveReport
from groma.solver.steps import Step, retract

pytestmark = pytest.mark.kernels

CASES = {
    "points": {},
    "points, shared intrinsics": {"shared_intrinsics": True},
    "points, own intrinsics": {"shared_intrinsics": False},
    "lines": {"num_points": 0, "num_lines": 12},
    "points and lines": {"num_lines": 8},
    "orthonormal lines": {"num_points": 0, "num_lines": 12, "line_chart": "orthonormal_left"},
    "right poses": {"pose_chart": "right"},
    "planes": {"num_planes": 2, "num_lines": 5, "shared_intrinsics": True},
    "robust": {"loss": Cauchy(1.0), "num_lines": 6},
}


def eliminated_step(problem, damping, solver="dense", threads=1, eliminate="auto"):
    layout = lay_out(problem, eliminate, chunk_size=16)
    equations = NormalEquations(layout, Workers(threads))
    system = ReducedSystem(equations)
    states = to_solver_order(layout)
    equations.linearize(states, equations.prepare(states))
    system.eliminate(damping)
    system.assemble(damping)
    linear = linear_solver(layout, solver)
    if solver == "pcg":
        linear.model_tolerance = 0.0
    kept = linear.solve(system.S, system.rhs)
    return layout, equations, system, states, Step(kept, system.landmark_steps(kept))


def step_by_group(layout, step):
    """Increments (count, dof) of each group in the order of the problem."""
    result = {}
    for kept, delta in zip(layout.kept, step.kept, strict=True):
        blocks = delta.reshape(kept.count, kept.width)
        for member in kept.members:
            part = blocks[:, member.offset : member.offset + member.dof]
            result[member.group] = part if member.block_of is None else part[member.block_of]
    for group, delta in zip(layout.eliminated, step.landmarks, strict=True):
        part = np.empty((group.count, group.dof))
        part[group.order] = delta.reshape(group.count, group.dof)
        result[group.group] = part
    return result


def dense_step(problem, damping, eliminated):
    H, g, columns = dense_normal_equations(problem)
    D = np.maximum(np.diag(H), MIN_DIAGONAL)
    for name, (first, dof) in columns.items():
        group = problem.variables[name]
        if name in eliminated:
            D[first : first + len(group) * dof] *= LANDMARK_DAMPING.get(group.manifold.kind, 1.0)
    step = np.linalg.solve(H + damping * np.diag(D), -g)
    return {
        name: step[first : first + len(problem.variables[name]) * dof].reshape(-1, dof)
        for name, (first, dof) in columns.items()
    }


@pytest.mark.parametrize("case", ["points, own intrinsics", "points and lines", "planes"])
def test_compact_equations_give_the_same_step(case):
    """Blocks kept in single precision serve back-substitution alone: cameras are exact, landmarks nearly."""
    problem = scene_problem(**CASES[case])
    expected = eliminated_step(problem, 1e-2)[-1]
    layout = lay_out(problem, chunk_size=16)
    equations = NormalEquations(layout, Workers(1), compact=True)
    system = ReducedSystem(equations)
    states = to_solver_order(layout)
    inputs = equations.prepare(states)
    equations.linearize(states, inputs, lambda share, chunk: system.eliminate_chunk(share, chunk, 1e-2))
    system.assemble(1e-2)
    kept = linear_solver(layout, "dense").solve(system.S, system.rhs)
    for got, wanted in zip(kept, expected.kept, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-12 * np.abs(wanted).max())
    assert all(W.dtype == np.float32 for blocks in equations.W for W in blocks.values())
    for got, wanted in zip(system.landmark_steps(kept), expected.landmarks, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-4, atol=1e-4 * np.abs(wanted).max())


@pytest.mark.parametrize("solver", ["dense", "sparse", "pcg"])
@pytest.mark.parametrize("case", CASES)
def test_step_equals_dense_step(case, solver):
    problem = scene_problem(**CASES[case])
    layout, *_, step = eliminated_step(problem, 1e-2, solver)
    got, expected = step_by_group(layout, step), dense_step(problem, 1e-2, [e.group for e in layout.eliminated])
    assert got.keys() == expected.keys()
    tolerance = 1e-5 if solver == "pcg" else 1e-8
    for name in expected:
        np.testing.assert_allclose(got[name], expected[name], atol=tolerance * np.abs(expected[name]).max())


def test_own_intrinsics_share_a_block_with_their_pose():
    layout = lay_out(scene_problem(shared_intrinsics=False))
    assert [kept.width for kept in layout.kept] == [10]
    layout = lay_out(scene_problem(shared_intrinsics=True))
    assert [kept.width for kept in layout.kept] == [6, 4]


@pytest.mark.parametrize("eliminate", [(), ("points",), ("lines",)])
def test_whatever_is_eliminated_the_step_is_the_dense_one(eliminate):
    problem = scene_problem(num_lines=6)
    layout, *_, step = eliminated_step(problem, 1e-2, eliminate=eliminate)
    got, expected = step_by_group(layout, step), dense_step(problem, 1e-2, [e.group for e in layout.eliminated])
    for name in expected:
        np.testing.assert_allclose(got[name], expected[name], atol=1e-8 * np.abs(expected[name]).max())


@pytest.mark.compiled
def test_threads_do_not_change_the_step(monkeypatch):
    """To the last digit: how the sums are divided depends on the problem alone."""
    monkeypatch.setattr(parallel, "FACTORS_FOR_THREADS", 0)
    monkeypatch.setattr(linearization, "LINEARISED_IN_THREADS", 0)
    monkeypatch.setattr(parallel, "USES_OF_A_BLOCK", 1)
    problem = scene_problem(num_points=80, num_lines=40)
    _layout, equations, *_, one = eliminated_step(problem, 1e-2)
    assert len(equations.shares) > 4
    for threads in (2, 3, 7, 40):
        _, *_, other = eliminated_step(problem, 1e-2, threads=threads)
        for first, second in zip(one.parts(), other.parts(), strict=True):
            np.testing.assert_array_equal(first, second)
    monkeypatch.setattr(parallel, "FACTORS_FOR_THREADS", 10**9)
    _, equations, *_, alone = eliminated_step(problem, 1e-2)
    assert len(equations.shares) == 1
    for first, second in zip(one.parts(), alone.parts(), strict=True):
        np.testing.assert_allclose(first, second, rtol=1e-9, atol=1e-12)


def test_an_error_in_a_thread_is_raised():
    for threads in (1, 3):
        workers, done = Workers(threads), []

        def work(task, done=done):
            if task == 2:
                raise ValueError("task 2")
            done.append(task)
            return task

        with pytest.raises(ValueError, match="task 2"):
            workers.map(work, 5)
        assert workers.map(lambda task: task * task, 9) == [task * task for task in range(9)]
        workers.close()


def test_held_coordinates_do_not_move():
    problem = scene_problem(num_lines=4)
    constant = np.zeros((5, 6), dtype=bool)
    constant[0] = True
    constant[1, 2] = True
    held_lines = np.array([True, False, False, False])
    variables = dict(problem.variables)
    for name, mask in (("poses", constant), ("lines", held_lines)):
        variables[name] = type(variables[name])(variables[name].manifold, variables[name].state, mask)
    problem = type(problem)(variables, problem.factors)
    layout, *_, step = eliminated_step(problem, 1e-2)
    got, expected = step_by_group(layout, step), dense_step(problem, 1e-2, [e.group for e in layout.eliminated])
    assert np.all(got["poses"][0] == 0)
    assert got["poses"][1, 2] == 0
    assert np.all(got["lines"][0] == 0)
    for name in expected:
        np.testing.assert_allclose(got[name], expected[name], atol=1e-8 * np.abs(expected[name]).max())


def flat(layout, columns, parts):
    by_group = step_by_group(layout, parts)
    return np.concatenate([by_group[name].reshape(-1) for name in columns])


@pytest.mark.parametrize("case", ["points", "planes"])
def test_quadratic_model(case):
    """Gradient and diagonal agree with the dense matrices."""
    problem = scene_problem(**CASES[case])
    layout, equations, system, *_ = eliminated_step(problem, 1e-2)
    H, g, columns = dense_normal_equations(problem)
    np.testing.assert_allclose(
        flat(layout, columns, Step(equations.g_kept, equations.g_landmarks)), g, atol=1e-9 * np.abs(g).max()
    )
    dofs = [e.dof for e in layout.eliminated]
    landmarks = [V.reshape(-1, n * n)[:, :: n + 1].reshape(-1) for V, n in zip(equations.V, dofs, strict=True)]
    diagonal = Step([system.diagonal(c).reshape(-1) for c in range(len(layout.kept))], landmarks)
    np.testing.assert_allclose(flat(layout, columns, diagonal), np.diag(H), rtol=1e-9)


@pytest.mark.parametrize("solver", ["dense", "pcg"])
def test_promised_decrease_is_that_of_the_quadratic_model(solver):
    """Points are damped less than lines and cameras, and conjugate gradients stop early; the promise holds for both."""
    problem = scene_problem(num_lines=8)
    layout = lay_out(problem, chunk_size=16)
    options = SolverOptions(linear_solver=solver, initial_damping=0.1)
    joint = JointProblem(layout, Workers(1), options, Stopwatch(SolveReport().seconds))
    start = joint.start()
    np.testing.assert_allclose(start.cost, joint.equations.cost(start.inputs), rtol=1e-12)
    trial = joint.try_step()
    H, g, columns = dense_normal_equations(problem)
    delta = flat(layout, columns, trial.step)
    np.testing.assert_allclose(trial.promised, -g @ delta - 0.5 * delta @ H @ delta, rtol=1e-9)
    np.testing.assert_allclose(trial.gain_ratio, (start.cost - trial.cost) / trial.promised, rtol=1e-12)


def test_linearisation_predicts_the_cost():
    """A tiny step changes the cost by the gradient's share."""
    problem = scene_problem(num_lines=8, num_planes=1, loss=Cauchy(2.0))
    layout, equations, _system, states, step = eliminated_step(problem, 1e-2)
    g = Step(equations.g_kept, equations.g_landmarks)
    h = 1e-6
    costs = [equations.cost(equations.prepare(retract(layout, states, step.scaled(sign * h)))) for sign in (1, -1)]
    np.testing.assert_allclose((costs[0] - costs[1]) / (2 * h), g.dot(step), rtol=1e-6)
