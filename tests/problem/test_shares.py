# SPDX-License-Identifier: BSD-3-Clause
"""The work on a problem divided among threads: what each share has, sums in order, costs of many chunks."""

import numpy as np
import pytest

from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.factors.losses import Cauchy
from groma.problem import linearization, parallel
from groma.problem.lay_out import lay_out
from groma.problem.linearization import NormalEquations, to_solver_order
from groma.problem.parallel import OrderedSums, Workers, shares_of
from groma.scene import synthetic


@pytest.fixture
def layout(monkeypatch):
    """A scene whose lines stay in the reduced system, in many small chunks and three shares."""
    scene = synthetic.holistic(8, seed=1).start
    problem = assemble(scene, AssemblyOptions(loss=Cauchy(2.0))).problem
    monkeypatch.setattr(parallel, "num_shares", lambda layout: 3)
    return lay_out(problem, chunk_size=12)


def test_every_share_has_a_third_of_each_kind_of_factor(layout):
    shares = shares_of(layout)
    chunks = [id(chunk) for share in shares for chunk in share]
    assert sorted(chunks) == sorted(map(id, layout.chunks))
    parts = np.zeros((3, len(layout.factors)))
    for k, share in enumerate(shares):
        for chunk in share:
            for f, begin, end in chunk.factors:
                parts[k, f] += end - begin
    totals = parts.sum(axis=0)
    assert (totals == [len(factor.factor) for factor in layout.factors]).all()
    alone = [f for f, factor in enumerate(layout.factors) if factor.eliminated is None and totals[f] > 36]
    assert alone, "the scene should have factors of lines alone"
    for f in alone:  # to the size of a chunk
        assert np.abs(parts[:, f] - totals[f] / 3).max() <= 12
    assert np.abs(parts.sum(axis=1) - totals.sum() / 3).max() <= 0.2 * totals.sum()


def test_costs_are_those_of_all_factors_whatever_the_runs(layout, monkeypatch):
    """The cost by runs of chunks is the sum over factors; of each landmark, the sum over its own; in any threads."""
    monkeypatch.setattr(linearization, "COSTS_IN_THREADS", 0)
    states = to_solver_order(layout)
    found = []
    for threads in (1, 3):
        workers = Workers(threads)
        equations = NormalEquations(layout, workers)
        inputs = equations.prepare(states)
        of_landmarks = [np.zeros(group.count) for group in layout.eliminated]
        found.append((equations.cost(inputs, of_landmarks), *map(np.copy, of_landmarks)))
        workers.close()
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)
    total, wanted = 0.0, [np.zeros(group.count) for group in layout.eliminated]
    for f, factor in enumerate(layout.factors):
        residual = np.zeros((len(factor.factor), factor.factor.residual_size))
        factor.factor.residuals(inputs[f], 0, len(residual), residual)
        information = np.asarray(factor.factor.sqrt_information)
        if information.ndim == 3:
            residual = np.einsum("nij,nj->ni", information, residual)
        else:
            residual = residual * information.reshape(-1, 1)
        rho = 0.5 * factor.factor.loss.evaluate((residual**2).sum(axis=1))[0]
        total += rho.sum()
        if factor.eliminated is not None:
            np.add.at(wanted[factor.eliminated], factor.landmark, rho)
    assert found[0][0] == pytest.approx(total, rel=1e-12)
    for one, other in zip(found[0][1:], wanted, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(("costs", "records", "handed_over"), [(None, None, []), (0, None, [3]), (0, 0, [3, 3])])
def test_little_work_wakes_no_other_thread(layout, monkeypatch, costs, records, handed_over):
    """Some hundred factors are done sooner than another thread wakes; costs are compared with more than records."""
    for name, least in (("COSTS_IN_THREADS", costs), ("LINEARISED_IN_THREADS", records)):
        if least is not None:
            monkeypatch.setattr(linearization, name, least)
    calls, states = [], to_solver_order(layout)
    monkeypatch.setattr(
        parallel, "take_in_turn", lambda pool, helpers, work, tasks: calls.append(len(tasks)) or list(map(work, tasks))
    )
    workers = Workers(2)
    equations = NormalEquations(layout, workers)
    inputs = equations.prepare(states)
    equations.cost(inputs)
    equations.linearize(states, inputs)
    workers.close()
    assert calls == handed_over


def test_chunks_that_are_not_wanted_are_left_out(layout):
    states = to_solver_order(layout)
    equations = NormalEquations(layout, Workers(1))
    inputs = equations.prepare(states)
    chosen = {id(chunk) for chunk in layout.chunks[::2]}
    some = equations.cost(inputs, wanted=lambda chunk: id(chunk) in chosen)
    others = equations.cost(inputs, wanted=lambda chunk: id(chunk) not in chosen)
    assert some > 0.0 and others > 0.0
    assert some + others == pytest.approx(equations.cost(inputs), rel=1e-12)


def test_sums_are_in_the_order_of_the_shares_whoever_ends_first():
    """Large terms that cancel tell the order: (1 + 1e16) - 1e16 is 0, 1 + (1e16 - 1e16) is 1."""
    values = [1.0, 1e16, 0.0, -1e16, 0.25]
    spans = [{"a": [(0, 1), (k, k + 1)]} if k != 2 else {} for k in range(5)]
    expected = np.array([((1.0 + 1e16) - 1e16) + 0.25, 1e16, 0.0, -1e16, 0.25])
    sums = OrderedSums({"a": 5}, spans)
    for order in ([0, 1, 3, 4], [4, 3, 1, 0], [3, 0, 4, 1]):
        sums.clear()
        for share in order:
            sums.of(share)["a"][0] += values[share]
            if share:
                sums.of(share)["a"][share] += values[share]
        for share in order:
            sums.end(share)
        np.testing.assert_array_equal(sums.total()["a"], expected)


def test_one_thread_adds_to_one_copy():
    sums = OrderedSums({"a": 3}, [{"a": [(0, 3)]}] * 4)
    places = set()
    for share in range(4):
        own = sums.of(share)["a"]
        np.testing.assert_array_equal(own, 0.0)  # the first begins with a clean total, the others with a clean copy
        own += 1.0
        places.add(id(own))
        sums.end(share)
    assert len(places) == 2
    np.testing.assert_array_equal(sums.total()["a"], 4.0)


def test_what_was_added_before_an_error_is_forgotten():
    sums = OrderedSums({"a": 2}, [{"a": [(0, 2)]}] * 3)
    sums.of(1)["a"] += 7.0
    sums.of(0)["a"] += 7.0
    sums.end(0)  # the second share never ends
    sums.clear()
    for share in range(3):
        sums.of(share)["a"][:] += share
        sums.end(share)
    np.testing.assert_array_equal(sums.total()["a"], 3.0)


def test_what_others_add_to_the_sums_is_cleared_too():
    """Where nothing is eliminated, as in a graph of poses, the sums are all from elsewhere."""
    sums = OrderedSums({"a": 2}, [{}])
    sums.total()["a"] += 7.0
    sums.clear()
    np.testing.assert_array_equal(sums.total()["a"], 0.0)
