# SPDX-License-Identifier: BSD-3-Clause
"""Lenses that are estimated beside lines: where the estimate begins has no part in it, and its covariance is true."""

import numpy as np
import pytest

from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.consistency_scenes import drawn
from groma.cameras import model
from groma.solver.covariance.marginals import Covariances
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

pytestmark = [pytest.mark.kernels, pytest.mark.compiled]

NOISE = 0.5
LENS = [-0.12, 0.03, 0.001, -0.001]
OPTIONS = AssemblyOptions(
    gauge="first_camera", planes=False, point_sigma_px=NOISE, line_sigma_px=NOISE, refine_intrinsics=True,
    refine_principal_point=True, drop_behind=False,
)  # fmt: skip


def seen_through_a_lens(seed):
    """A scene of points and lines in images of OPENCV cameras, with the true calibration."""
    rng = np.random.default_rng(seed)
    scene = drawn(10, 0.0, rng, False)
    straight, bent = scene.cameras, scene.cameras.with_model("OPENCV")
    bent = bent.replace(params=np.hstack([bent.params[:, :4], np.tile(LENS, (len(bent), 1))]))

    def moved(pixels, image_idx):
        camera = scene.images.camera_idx[image_idx]
        rays = model("PINHOLE").unproject(straight.params[camera, :4], np.ascontiguousarray(pixels))
        exact = model("OPENCV").project(bent.params[camera], rays)
        return exact + rng.normal(0.0, NOISE, exact.shape)

    points, lines = scene.point_observations, scene.line_observations
    ends = [moved(lines.segment[:, at : at + 2], lines.image_idx) for at in (0, 2)]
    return scene.replace(
        cameras=bent,
        point_observations=points.replace(pixel=moved(points.pixel, points.image_idx)),
        line_observations=lines.replace(segment=np.hstack(ends)),
    )


def estimated(scene):
    return solve(assemble(scene, OPTIONS).problem, SolverOptions(function_tolerance=1e-14, max_iterations=60)).problem


def test_another_start_has_the_same_minimum():
    """Rays that were made once, with a focal length 2 % off, would keep it there."""
    scene = seen_through_a_lens(0)
    off = scene.cameras.params * [1.02, 1.02, 1.0, 1.0, 0.8, 0.8, 1.0, 1.0]
    first, second = (
        estimated(start).variables["intrinsics/OPENCV"].state
        for start in (scene, scene.replace(cameras=scene.cameras.replace(params=off)))
    )
    np.testing.assert_allclose(second, first, rtol=1e-5, atol=1e-7)


def test_errors_of_estimated_lenses_are_those_of_their_covariance():
    """Of eight runs the mean squared error in variances is the number of parameters, within four deviations."""
    squares = []
    for seed in range(8):
        scene = seen_through_a_lens(seed)
        problem = estimated(scene)
        covariances = Covariances(problem, gauge="held")
        error = problem.variables["intrinsics/OPENCV"].state - scene.cameras.params
        squares += [
            e @ np.linalg.solve(sigma, e) for e, sigma in zip(error, covariances.of("intrinsics/OPENCV"), strict=True)
        ]
    dof = len(LENS) + 4
    assert abs(np.mean(squares) - dof) < 4.0 * np.sqrt(2.0 * dof / len(squares))
