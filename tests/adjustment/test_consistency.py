# SPDX-License-Identifier: BSD-3-Clause
"""The Monte-Carlo test of covariances: averages in the band for every kind and gauge, it notices wrong noise, and the
truths it draws miss their relations by the noise that these are given."""

import json
from dataclasses import replace

import numpy as np
import pytest

from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.consistency import _nees, consistency
from groma.adjustment.consistency_scenes import STRUCTURE_SIGMA_PX, drawn
from groma.adjustment.stages import with_loss
from groma.errors import InputError
from groma.factors import LineDirection, PointOnLine, PointOnPlane, SegmentOnPlane
from groma.factors.contract import Ref
from groma.factors.losses import Cauchy, GemanMcClure, Trivial
from groma.problem.problem import Problem
from groma.solver.covariance.marginals import Covariances
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

pytestmark = pytest.mark.kernels


@pytest.mark.compiled
def test_every_kind_in_both_gauges():
    report = consistency(runs=4, seed=0, num_images=8)
    assert [(row.gauge, row.kind) for row in report.rows] == [
        ("held", "poses"), ("held", "points"), ("held", "lines"), ("held", "planes"), ("held", "directions"),
        ("held", "intrinsics"), ("inner", "poses"), ("inner", "points"), ("inner", "lines"), ("inner", "intrinsics"),
    ]  # fmt: skip
    assert report.passed
    assert [row.dof for row in report.rows] == [6, 3, 4, 3, 2, 4, 6, 3, 4, 4]
    assert json.loads(json.dumps(report.to_dict(), allow_nan=False))["passed"] is True


@pytest.mark.compiled
def test_wrong_noise_is_noticed():
    report = consistency(runs=4, seed=0, num_images=8, noise_px=0.5, believed_px=0.35, gauges=("held",))
    assert not report.passed
    assert all(row.average > row.dof for row in report.rows if row.kind in ("poses", "points", "lines"))


def _mean_nees(relation_loss, wrong=0.0):
    """Average NEES per degree of freedom by group of variables, over four scenes."""
    options = AssemblyOptions(
        point_sigma_px=0.5, line_sigma_px=0.5, structure_sigma_px=STRUCTURE_SIGMA_PX, gauge="first_camera",
        drop_behind=False,
    )  # fmt: skip
    found: dict[str, list[float]] = {}
    for seed in range(4):
        rng = np.random.default_rng(seed)
        truth = with_loss(assemble(drawn(20, 0.5, rng, relations=True), options).problem, Trivial(), relation_loss)
        factors = list(truth.factors)
        for k, factor in enumerate(factors):
            if isinstance(factor, PointOnPlane):
                shift = (rng.random(len(factor)) < wrong).astype(int)
                plane = (factor.plane.index + shift) % len(truth.variables["planes"])
                factors[k] = replace(factor, plane=Ref("planes", plane))
        truth = Problem(truth.variables, factors)
        estimate = solve(truth, SolverOptions(function_tolerance=1e-12)).problem
        covariances = Covariances(estimate)
        for name in ("frames", "points", "lines", "planes", "directions"):
            group = estimate.variables[name]
            errors = group.manifold.local(group.state, truth.variables[name].state)
            found.setdefault(name, []).extend(_nees(errors, covariances.of(name)) / group.manifold.dof)
    return {name: np.mean(values) for name, values in found.items()}


@pytest.mark.compiled
def test_robust_relations_leave_deviations_as_true_as_least_squares_do():
    """Reweighting bends what relations tell; the deviations stated under their losses stay those of the errors.

    The scenes are the same, so what chance does to their averages is common. Of a landmark with one relation of its own
    under a Cauchy loss of one sigma, the error over its deviation has by quadrature an rms of 1.07 at most, a NEES of
    1.15; a twentieth is left to chance. A tenth of the points on planes may be on others: what the loss gives up tells
    nothing, and spoils nothing.
    """
    plain = _mean_nees(Trivial())
    for loss, wrong in ((GemanMcClure(4.0), 0.0), (GemanMcClure(4.0), 0.1), (Cauchy(1.0), 0.0)):
        for name, average in _mean_nees(loss, wrong).items():
            assert average < 1.2 * plain[name], (loss, wrong, name)


def test_relations_are_missed_by_their_noise():
    """Whitened residuals of every kind of relation at the truth are standard normal."""
    options = AssemblyOptions(structure_sigma_px=STRUCTURE_SIGMA_PX, gauge="first_camera", drop_behind=False)
    squares: dict[str, list[float]] = {}
    counts: dict[str, int] = {}
    for seed in range(6):
        scene = drawn(30, 0.5, np.random.default_rng(seed), relations=True)
        problem = assemble(scene, options).problem
        for factor in problem.factors:
            if not isinstance(factor, (PointOnPlane, PointOnLine, SegmentOnPlane, LineDirection)):
                continue
            ambients = tuple(problem.variables[ref.group].ambient() for _, ref in factor.references())
            residual = np.empty((len(factor), factor.residual_size))
            factor.residuals(factor.prepare(ambients), 0, len(factor), residual)
            name = type(factor).__name__
            squares.setdefault(name, []).extend((residual**2).sum(axis=1) * factor.sqrt_information**2)
            counts[name] = factor.residual_rank
    assert set(squares) == {"PointOnPlane", "PointOnLine", "SegmentOnPlane", "LineDirection"}
    for name, values in squares.items():
        mean, sigma = counts[name], np.sqrt(2 * counts[name] / len(values))
        assert abs(np.mean(values) - mean) < 3 * sigma, name


@pytest.mark.slow
def test_averages_in_the_band():
    report = consistency(runs=100, seed=0)
    for row in report.rows:
        assert row.inside, f"{row.gauge} {row.kind}: {row.average:.3f} not in {row.low:.3f} .. {row.high:.3f}"
    wrong = consistency(runs=100, seed=0, believed_px=0.45)
    assert not wrong.passed


@pytest.mark.slow
def test_one_row_in_twenty_is_outside():
    """Over five seeds, none of which is chosen, hardly more than one in twenty; rows of one gauge go together."""
    rows = [row for seed in range(1, 6) for row in consistency(runs=60, seed=seed).rows]
    assert all(row.passed for row in rows)
    assert sum(not row.inside for row in rows) <= 0.2 * len(rows)


def test_wrong_options_are_refused():
    with pytest.raises(InputError, match="At least 2 runs"):
        consistency(runs=1)
    with pytest.raises(InputError, match="'held' or 'inner'"):
        consistency(gauges=("free",))
