"""Solves in shards that do not form the reduced system: the same as those that do, and the same for any processes."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from problems import scene_problem
from test_shards import TIGHT, Together, cut, of_process

import groma.solver.reduce.shards as shards_module
from groma.errors import InputError
from groma.solver.linear.coarse import coarse_space
from groma.solver.options import SolverOptions
from groma.solver.reduce.shards import solve_shards
from groma.solver.reduce.single import SingleProcess


class Counting(SingleProcess):
    """One process that remembers how much it sums."""

    def __init__(self):
        super().__init__()
        self.sizes = []

    def sum(self, values):
        self.sizes.append(values.size)
        return values


@pytest.mark.parametrize("shared_intrinsics", [None, True, False])
def test_products_find_what_the_formed_system_finds(shared_intrinsics):
    """Blocks between poses, and between poses and shared or private calibrations.

    Three steps: with private calibrations a fourth follows directions so weak that rounding decides where it ends.
    """
    problem = scene_problem(num_cameras=6, num_points=60, num_lines=20, shared_intrinsics=shared_intrinsics)
    shards, options = cut(problem, 4), SolverOptions(linear_solver="pcg", threads=1, max_iterations=3)
    found = [
        solve_shards(problem.variables, shards, dataclasses.replace(options, shared_system=system))
        for system in ("formed", "products")
    ]
    assert found[0].report.iterations == found[1].report.iterations > 2
    for name, group in found[0].variables.items():
        size = max(1.0, np.abs(group.state).max())
        np.testing.assert_allclose(found[1].variables[name].state, group.state, rtol=0, atol=1e-9 * size)


def test_motions_of_clusters_are_those_of_the_formed_system(monkeypatch):
    """So many cameras that the preconditioner has a second level, whose matrix is a sum over shards, too."""
    import groma.solver.linear.coarse as module

    monkeypatch.setattr(module, "CLUSTER_SIZE", 3)
    problem = scene_problem(num_cameras=16, num_points=120)
    made = []
    monkeypatch.setattr("groma.solver.linear.pcg.coarse_space", lambda *a: made.append(coarse_space(*a)) or made[-1])
    options = SolverOptions(linear_solver="pcg", threads=1, max_iterations=5)
    formed = solve_shards(problem.variables, cut(problem, 3), dataclasses.replace(options, shared_system="formed"))
    assert made[-1] is not None and made[-1].count > 3
    products = solve_shards(problem.variables, cut(problem, 3), dataclasses.replace(options, shared_system="products"))
    factors = [made[number]._factor for number in (0, len(made) // 2)]
    np.testing.assert_allclose(*map(np.tril, factors), rtol=0, atol=1e-9 * np.abs(factors[0]).max())
    for name, group in formed.variables.items():
        np.testing.assert_allclose(products.variables[name].state, group.state, rtol=0, atol=1e-9)


@pytest.mark.parametrize("count", [2, 5])
def test_processes_with_shards_of_their_own_find_the_same_bits(count):
    problem = scene_problem(num_cameras=6, num_points=60, num_lines=20, shared_intrinsics=True)
    shards, options = cut(problem, 4), dataclasses.replace(TIGHT, shared_system="products")
    alone = solve_shards(problem.variables, shards, options)
    reducer = Together(count)

    def work(number):
        reducer.play(number)
        return solve_shards(*of_process(problem, shards[number::count]), options, reducer=reducer)

    with ThreadPoolExecutor(count) as pool:
        found = list(pool.map(work, range(count)))
    for solution in found:
        assert solution.report.final_cost == alone.report.final_cost
        for name in problem.variables.keys() - shards[0].landmarks.keys():
            np.testing.assert_array_equal(solution.variables[name].state, alone.variables[name].state)


def test_very_many_cameras_are_not_summed_to_a_system(monkeypatch):
    problem = scene_problem(num_cameras=12, num_points=120)
    one_step = SolverOptions(max_iterations=1, threads=1)
    formed, products = Counting(), Counting()
    solve_shards(problem.variables, cut(problem, 3), one_step, reducer=formed)
    monkeypatch.setattr(shards_module, "MAX_FORMED", 11)
    report = solve_shards(problem.variables, cut(problem, 3), one_step, reducer=products).report
    assert report.linear_solver == "pcg"
    assert formed.sizes[0] - products.sizes[0] >= 12 * 11 // 2 * 36 * 0.5
    assert sorted(set(products.sizes))[0] == 12 * 6
    with pytest.raises(InputError, match="conjugate gradients"):
        SolverOptions(shared_system="products", linear_solver="dense")
    with pytest.raises(InputError, match="shared_system must be one of"):
        SolverOptions(shared_system="some")
