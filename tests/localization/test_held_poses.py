# SPDX-License-Identifier: BSD-3-Clause
"""Errors of poses that a map was given and held: their size, and that queries know of them."""

import numpy as np
import pytest

from groma.adjustment.assemble import assemble, disassemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.geometry import se3
from groma.localization.errors.common_errors import common_errors
from groma.localization.errors.held_poses import held_poses
from groma.localization.errors.views import views_of
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.hypotheses import max_errors
from groma.localization.pose.matches import Matches
from groma.localization.pose.records import landmark_covariances
from groma.localization.pose.refinement import refine
from groma.scene import Relations
from groma.scene.synthetic import holistic
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

NOISE = 0.5
#: Standard deviations of the centres (the rooms are some units wide) and of the rotations of held poses.
CENTER, TURN = 0.02, 2e-3
HELD = AssemblyOptions(refine_poses=False, point_chart="euclidean", gauge="free")


def _world(seed, errors):
    """A true scene, the map of all its images but one from poses with these errors (unit normal), and that image."""
    rng = np.random.default_rng(seed)
    truth = (
        holistic(8, seed, noise_px=0.0).truth.keep(lines=[], planes=[], directions=[]).replace(relations=Relations())
    )
    seen = truth.point_observations
    noisy = truth.replace(
        point_observations=seen.replace(
            pixel=seen.pixel + rng.normal(0.0, NOISE, seen.pixel.shape), sigma=np.full(len(seen), NOISE)
        )
    )
    query = int(rng.integers(8))
    part = noisy.subset(np.setdiff1d(np.arange(8), [query]))
    twist = np.repeat(errors, 3) * rng.normal(size=(part.num_frames, 6))
    part = part.with_poses(se3.compose(se3.exp(twist), part.cam_from_world))
    solved = solve(assemble(part, HELD).problem, SolverOptions(max_iterations=60, function_tolerance=1e-9)).problem
    return truth, noisy, query, disassemble(part, solved)


@pytest.mark.kernels
@pytest.mark.compiled
def test_their_size_is_found():
    """Variances of seven poses are good to a quarter, their mean of 16 maps to 6 %."""
    found = []
    for seed in range(16):
        scene = _world(seed, (CENTER, TURN))[3]
        found.append(held_poses(scene).sigma ** 2)
    np.testing.assert_allclose(np.mean(found, axis=0), [CENTER**2, TURN**2], rtol=0.25)


@pytest.mark.kernels
def test_exact_poses_are_exact():
    """In the mean less is found than what noise alone makes of one pose that its own points are fitted to."""
    found, alone = [], []
    for seed in range(8):
        scene = _world(seed, (0.0, 0.0))[3]
        views = views_of(scene, "points", 0)
        found.append(held_poses(scene).sigma)
        information = np.zeros((scene.num_frames, 6, 6))
        np.add.at(information, views.frame, np.swapaxes(views.by_frame, 1, 2) @ views.by_frame)
        variance = np.linalg.inv(information).diagonal(axis1=1, axis2=2).mean(axis=0)
        alone.append(np.sqrt([variance[:3].mean(), variance[3:].mean()]))
    assert (np.mean(found, axis=0) < np.mean(alone, axis=0)).all(), (found, alone)


@pytest.mark.kernels
@pytest.mark.compiled
def test_queries_are_as_uncertain_as_the_poses():
    """Squared errors of six degrees: 24 queries have a mean of 1 with a standard deviation of 0.12, and of 0.2 with
    variances from seven poses each; without errors of poses they are told to be far better than they are.
    """
    knowing, plain = [], []
    for seed in range(24):
        truth, noisy, query, scene = _world(seed, (CENTER, TURN))
        covariance = landmark_covariances(assemble(scene, HELD).problem, "points", scene.num_points)
        rows = np.flatnonzero(noisy.point_observations.image_idx == query)
        place = {int(number): row for row, number in enumerate(scene.points.ids)}
        ids = noisy.points.ids[noisy.point_observations.point_idx[rows]]
        landmark = np.array([place.get(int(number), -1) for number in ids], np.int64)
        known = (landmark >= 0) & np.isfinite(np.append(covariance[:, 0, 0], np.nan)[landmark])
        rows, landmark = rows[known], landmark[known]
        matches = Matches(
            noisy.point_observations.pixel[rows], scene.points.xyz[landmark], point_sigma=np.full(len(rows), NOISE),
            point_covariance=covariance[landmark],
        )  # fmt: skip
        true = truth.cam_from_world[query]
        found = refine(QueryCamera.of(truth.cameras, 0), matches, true, max_errors(matches), gathered=True)
        errors, _ = common_errors(scene, scene, (1.0, 1.0), (False, False))
        assert errors is not None
        noise = found.covariance(matches)
        common = errors.of_query(found, (landmark, np.zeros(0, np.int64)))
        error = se3.log(se3.compose(true[None], se3.inverse(found.pose[None])))[0]
        knowing.append(error @ np.linalg.solve(noise + common, error) / 6.0)
        plain.append(error @ np.linalg.solve(noise, error) / 6.0)
    assert 0.6 < np.mean(knowing) < 1.4, (np.mean(knowing), np.mean(plain))
    assert np.mean(plain) > 3.0


def test_without_points_nothing_is_told():
    scene = holistic(3, 0, noise_px=0.0).truth.keep(points=[])
    found = held_poses(scene)
    assert not found.sigma.any() and not found.of_difference.any()
