"""Conjugate gradients with clusters of cameras: the clusters, the coarse system, and the solution."""

import numpy as np
import pytest
from problems import scene_problem

from groma.problem.lay_out import lay_out
from groma.problem.linearization import NormalEquations, to_solver_order
from groma.problem.parallel import Workers
from groma.solver.linear import coarse as _coarse
from groma.solver.linear.dense import Dense
from groma.solver.linear.pcg import ConjugateGradients
from groma.solver.linear.schur import ReducedSystem

pytestmark = pytest.mark.kernels


@pytest.fixture
def small_clusters(monkeypatch):
    monkeypatch.setattr(_coarse, "CLUSTER_SIZE", 4)
    monkeypatch.setattr(_coarse, "MIN_CLUSTERS", 2)


def reduced(damping=1e-4, **scene):
    layout = lay_out(scene_problem(**scene))
    equations = NormalEquations(layout, Workers(1))
    system = ReducedSystem(equations)
    states = to_solver_order(layout)
    equations.linearize(states, equations.prepare(states), lambda s, chunk: system.eliminate_chunk(s, chunk, damping))
    system.assemble(damping)
    return layout, system, states


def full(layout, S):
    M = np.zeros((layout.num_kept_unknowns,) * 2)
    Dense(layout).fill(S, M)
    return np.triu(M) + np.triu(M, 1).T


def test_clusters_cover_a_chain_in_runs(small_clusters):
    first = np.arange(29, dtype=np.int32)
    cluster = _coarse._clusters(first, first + 1, 30)
    assert np.bincount(cluster).max() <= 4
    assert (np.diff(cluster) >= 0).all()  # neighbours together, one run after the other
    apart = _coarse._clusters(np.zeros(0, np.int32), np.zeros(0, np.int32), 5)
    np.testing.assert_array_equal(np.sort(apart), np.arange(5))


@pytest.mark.parametrize("case", [{}, {"shared_intrinsics": False}, {"num_planes": 2, "num_lines": 5}])
def test_correction_is_the_coarse_solution(small_clusters, case):
    layout, system, states = reduced(num_cameras=12, num_points=40, views=4, **case)
    space = _coarse.coarse_space(layout)
    c = space.kept_class
    kept = layout.kept[c]
    space.follow(states)
    space.factorize(system.S[c, c])
    rows = kept.start + np.arange(kept.count * kept.width)
    S = full(layout, system.S)[np.ix_(rows, rows)]
    P = np.zeros((kept.count, kept.width, space.count, 7))
    P[np.arange(kept.count), :, space._cluster] = space._P.reshape(kept.count, kept.width, 7)
    P = P.reshape(len(rows), -1)
    r = np.random.default_rng(0).normal(size=len(rows))
    z = np.zeros_like(r)
    space.correct(r, z)
    np.testing.assert_allclose(z, P @ np.linalg.solve(P.T @ S @ P, P.T @ r), rtol=1e-4, atol=1e-6 * np.abs(z).max())


def test_conjugate_gradients_with_clusters_solve_the_system(small_clusters):
    layout, system, states = reduced(num_cameras=12, num_points=40, views=4)
    solver = ConjugateGradients(layout)
    solver.model_tolerance = 0.0
    expected = np.linalg.solve(full(layout, system.S), np.concatenate(system.rhs))
    for follows in (False, True):  # without states there are no clusters, and the result is the same
        if follows:
            solver.follow(states)
        (got,) = solver.solve(system.S, system.rhs)
        # the freedom of the whole scene is held by the damping alone, so single components keep fewer digits
        assert np.linalg.norm(got - expected) < 1e-5 * np.linalg.norm(expected)


def test_coarse_system_is_kept_while_the_cameras_stand(small_clusters):
    layout, system, states = reduced(num_cameras=12, num_points=40, views=4)
    space = _coarse.coarse_space(layout)
    S = system.S[space.kept_class, space.kept_class]
    space.follow(states)
    space.factorize(S)
    first = space._factor
    space.factorize(2.0 * S)
    assert space._factor is first
    group = layout.kept[space.kept_class].members[0].group
    moved = states[group].copy()
    moved[:, 4:] += 0.2
    space.follow({**states, group: moved})
    space.factorize(S)
    assert space._factor is not first


def test_few_cameras_have_no_clusters():
    assert _coarse.coarse_space(lay_out(scene_problem())) is None
