# SPDX-License-Identifier: BSD-3-Clause
"""Covariance of a pose when the errors of some points go together, against the scatter of solutions over many draws."""

import dataclasses

import numpy as np
import pytest
from problems import scene_problem

from groma.problem.problem import Problem
from groma.solver.covariance.clusters import clustered, with_kept
from groma.solver.covariance.marginals import Covariances
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

pytestmark = pytest.mark.kernels

GROUPS, POINTS = 20, 80
CLUSTER = np.arange(POINTS) % GROUPS


def _exact():
    """Points seen by four cameras, without noise; the first two cameras are held."""
    problem = scene_problem(num_points=POINTS, num_cameras=4, noise=0.0, disturb=0.0)
    held = np.zeros((4, 6), dtype=bool)
    held[:2] = True
    poses = dataclasses.replace(problem.variables["poses"], constant=held)
    return Problem({**problem.variables, "poses": poses}, problem.factors)


def _with_noise(problem, seed, common):
    """The problem with noise of 0.3 pixels in each measurement, and what all measurements of a cluster err alike."""
    (factor,) = problem.factors
    rng = np.random.default_rng(seed)
    noise = 0.3 * rng.normal(size=factor.pixels.shape)
    alike = common * rng.normal(size=(GROUPS, 2))[CLUSTER[factor.point.index]]
    noisy = dataclasses.replace(factor, pixels=factor.pixels + noise + alike, sqrt_information=1.0 / 0.3)
    return Problem(problem.variables, [noisy])


@pytest.mark.compiled
@pytest.mark.parametrize("common", [0.0, 0.6])
def test_clusters_tell_the_scatter_of_solutions(common):
    """Normalised errors of the third pose over 60 draws; to take alike errors for independent ones is wrong."""
    problem, apart, together = _exact(), 0.0, 0.0
    exact = problem.variables["poses"]
    for seed in range(60):
        solution = solve(_with_noise(problem, seed, common), SolverOptions(function_tolerance=1e-10))
        error = exact.manifold.local(exact.state[2:3], solution["poses"][2:3])[0]
        covariances = Covariances(solution.problem)
        apart += error[:3] @ np.linalg.inv(covariances.of("poses", 2)[0, :3, :3]) @ error[:3]
        own = clustered(covariances, ("poses", 2), "points", CLUSTER)
        together += (error[:3] ** 2 / np.diag(own)[:3]).sum()
    # Chi-square of 180 degrees of freedom: 125 to 245 but for one in a thousand; a variance of 20 clusters is too small
    # as often as too large, which makes its inverse larger by a tenth.
    assert 110.0 < together < 300.0
    assert (apart > 600.0) == (common > 0.0)


def test_covariances_with_one_variable_are_blocks_of_the_joint_one():
    """Of the poses that are free, with the third; held ones have none."""
    solution = solve(_with_noise(_exact(), 0, 0.0))
    covariances = Covariances(solution.problem)
    joint = covariances.joint([("poses", 2), ("poses", 3)])
    found = with_kept(covariances, "poses", 2)["poses"]
    np.testing.assert_allclose(found[2:].reshape(12, 6), joint[:, :6], atol=1e-9 * np.abs(joint).max())
    assert not found[:2].any()
