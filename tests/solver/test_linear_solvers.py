"""Solvers of the reduced system: which one is chosen, one from outside, what they report, singular systems."""

import numpy as np
import pytest
from problems import scene_problem

import groma.solver.linear.contract as contract
from groma.errors import InputError
from groma.problem.lay_out import lay_out
from groma.problem.linearization import NormalEquations, to_solver_order
from groma.problem.parallel import Workers
from groma.solver.linear.choice import linear_solver, linear_solver_names
from groma.solver.linear.contract import register_linear_solver
from groma.solver.linear.dense import Dense
from groma.solver.linear.schur import ReducedSystem
from groma.solver.options import SolverOptions
from groma.solver.solve import solve


@pytest.fixture
def outside(monkeypatch):
    """A solver of one's own: dense, by NumPy, counting its calls."""
    monkeypatch.setattr(contract, "_SOLVERS", dict(contract._SOLVERS))

    @register_linear_solver("numpy")
    class ByNumPy:
        name = "numpy"
        num_iterations = 0
        residual = None
        calls = 0
        seconds = np.inf

        def __init__(self, layout):
            self.layout = layout

        def expected_seconds(self):
            return self.seconds

        def follow(self, states):
            pass

        def solve(self, blocks, rhs):
            ByNumPy.calls += 1
            n = self.layout.num_kept_unknowns
            M = np.zeros((n, n))
            Dense(self.layout).fill(blocks, M)
            x = np.linalg.solve(np.triu(M) + np.triu(M, 1).T, np.concatenate(rhs))
            return [x[c.start : c.start + c.count * c.width] for c in self.layout.kept]

    return ByNumPy


def test_a_solver_from_outside_is_chosen_by_its_name(outside):
    problem = scene_problem(num_cameras=6, num_points=60)
    report = solve(problem, SolverOptions(linear_solver="numpy")).report
    dense = solve(problem, SolverOptions(linear_solver="dense")).report
    assert report.linear_solver == "numpy" and outside.calls == report.iterations == dense.iterations
    np.testing.assert_allclose(report.final_cost, dense.final_cost, rtol=1e-9)


def test_auto_takes_the_solver_that_expects_to_be_fastest(outside):
    layout = lay_out(scene_problem())
    assert linear_solver_names() == ("auto", "dense", "pcg", "sparse", "numpy")
    assert linear_solver(layout, "auto").name == "dense"
    outside.seconds = -1.0
    assert linear_solver(layout, "auto").name == "numpy"


def test_names():
    with pytest.raises(InputError, match="linear_solver must be one of auto, dense, pcg, sparse; got 'numpy'"):
        SolverOptions(linear_solver="numpy")
    with pytest.raises(InputError, match="registered already"):
        register_linear_solver("dense")(lambda layout: Dense(layout))


def reduced(damping, **scene):
    layout = lay_out(scene_problem(num_cameras=6, num_points=60, **scene))
    equations = NormalEquations(layout, Workers(1))
    system, states = ReducedSystem(equations), to_solver_order(layout)
    equations.linearize(states, equations.prepare(states), lambda s, chunk: system.eliminate_chunk(s, chunk, damping))
    system.assemble(damping)
    return layout, system


@pytest.mark.parametrize("name", ["dense", "sparse", "pcg"])
@pytest.mark.parametrize("shared_intrinsics", [None, True])
def test_iterations_and_residual_are_reported(name, shared_intrinsics):
    layout, system = reduced(1e-3, shared_intrinsics=shared_intrinsics)
    solver = linear_solver(layout, name)
    x = solver.solve(system.S, system.rhs)
    M = np.zeros((layout.num_kept_unknowns,) * 2)
    Dense(layout).fill(system.S, M)
    left = np.concatenate(system.rhs) - (np.triu(M) + np.triu(M, 1).T) @ np.concatenate(x)
    if name == "pcg":
        assert solver.num_iterations > 0
        np.testing.assert_allclose(np.concatenate(solver.residual), left, atol=1e-9 * np.abs(system.rhs[0]).max())
    else:
        assert solver.num_iterations == 0 and solver.residual is None
        np.testing.assert_allclose(left, 0.0, atol=1e-8 * np.abs(system.rhs[0]).max())


@pytest.mark.parametrize("name", ["dense", "sparse"])
@pytest.mark.parametrize("shared_intrinsics", [None, True])
def test_singular_systems_have_no_solution(name, shared_intrinsics):
    """A free scene: seven directions cost nothing. Rounding leaves pivots that are tiny, not zero."""
    layout, system = reduced(0.0, shared_intrinsics=shared_intrinsics)
    assert linear_solver(layout, name).solve(system.S, system.rhs) is None
