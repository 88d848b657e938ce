# SPDX-License-Identifier: BSD-3-Clause
"""Deviations of cameras by leaving out landmarks, against leaving them out, and against errors that go together."""

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

import groma
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.consistency_scenes import drawn
from groma.adjustment.misfit.jackknife import landmark_jackknife, observations_alone
from groma.adjustment.uncertainty import pose_uncertainty
from groma.scene import CameraPositions
from groma.scene.survey import diagonal_covariance
from groma.scene.synthetic import holistic
from groma.solver.covariance.marginals import Covariances
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

EXACT = SolverOptions(function_tolerance=1e-14, max_iterations=50)
OPTIONS = AssemblyOptions(point_sigma_px=0.5, line_sigma_px=0.5, gauge="first_camera")


def few(scene, points, lines):
    """Some of the landmarks, those that most images see."""
    seen = [
        np.bincount(scene.point_observations.point_idx, minlength=scene.num_points),
        np.bincount(scene.line_observations.line_idx, minlength=scene.num_lines),
    ]
    kept = [np.isin(np.arange(len(n)), np.argsort(-n)[:many]) for n, many in zip(seen, (points, lines), strict=True)]
    return scene.keep(points=kept[0], lines=kept[1])


def solved(scene):
    return solve(assemble(scene, OPTIONS).problem, EXACT).problem


def test_it_is_what_leaving_out_does():
    scene = few(drawn(6, 0.5, np.random.default_rng(3), relations=False), 40, 12)
    full = solved(scene)
    _, found = landmark_jackknife(Covariances(full))
    frames, summed = full.variables["frames"], np.zeros(found.shape)
    for kind, count in (("points", scene.num_points), ("lines", scene.num_lines)):
        for row in range(count):
            without = solved(scene.keep(**{kind: np.arange(count) != row})).variables["frames"]
            moved = frames.manifold.local(frames.state, without.state)
            summed += moved[:, :, None] * moved[:, None, :]
    free = np.arange(1, len(found))
    ratio = np.sqrt(np.trace(found[free], axis1=1, axis2=2) / np.trace(summed[free], axis1=1, axis2=2))
    assert ratio == pytest.approx(1.0, abs=0.1)  # one step of a problem that is not linear
    assert np.median(ratio) == pytest.approx(1.0, abs=0.03)


def test_independent_noise_of_known_size_gives_the_stated_deviations():
    ratios = []
    for seed in range(4):
        scene = drawn(8, 0.5, np.random.default_rng(seed), relations=False)
        stated, found = landmark_jackknife(Covariances(solved(scene)))
        ratios.append(np.sqrt(np.trace(found[1:], axis1=1, axis2=2) / np.trace(stated[1:], axis1=1, axis2=2)))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.08)


def test_errors_that_go_together_are_seen():
    """Over ten draws the centres err as the jackknife says, and by much more than the noise of all residuals says.

    One point in ten drifts along its track, as outlines of round bodies do.
    """
    truth = drawn(8, 0.0, np.random.default_rng(0), relations=False).points_only()
    seen, errors, stated, told = truth.point_observations, [], [], []
    for draw in range(10):
        rng = np.random.default_rng(draw)
        drift = rng.normal(0.0, 1.0, (truth.num_points, 2)) * (rng.random((truth.num_points, 1)) < 0.1)
        noise = drift[seen.point_idx] * (seen.image_idx - 3.5)[:, None] + rng.normal(0, 0.1, seen.pixel.shape)
        scene = truth.replace(point_observations=seen.replace(pixel=seen.pixel + noise))
        result = groma.adjust(scene, groma.AdjustOptions(loss="none"))
        errors.append(groma.evaluate_poses(result.scene, truth).center_rmse)
        for to, by_landmarks in ((stated, False), (told, True)):
            numbers = pose_uncertainty(result.scene, result.problem, result.report.sigma0, by_landmarks=by_landmarks)
            to.append(numbers["center"]["median"])
    assert 0.7 < np.mean(errors) / np.mean(told) < 1.4
    assert np.mean(errors) / np.mean(stated) > 1.5


def test_relations_are_no_observations():
    scene = drawn(6, 0.5, np.random.default_rng(2), relations=True)
    problem = assemble(scene, OPTIONS).problem
    alone = observations_alone(problem)
    assert {"planes", "directions"} & {*problem.variables} and not {"planes", "directions"} & {*alone.variables}
    assert len(alone.factors) < len(problem.factors)
    result = groma.adjust(scene, groma.AdjustOptions(point_sigma_px=0.5, line_sigma_px=0.5))
    numbers = pose_uncertainty(result.scene, result.problem, by_landmarks=True)
    assert numbers["gauge"] == "held" and 0.6 < numbers["factor"] < 1.6


def test_landmarks_do_not_tell_where_measurements_put_the_scene():
    """With noise as stated, deviations in the frame of positions of 2 cm are those of least squares: centimetres."""
    scene = drawn(8, 0.3, np.random.default_rng(4), relations=False)
    rows, sigma = np.arange(3), np.full((3, 3), 0.02)
    xyz = scene.cam_centers_in_world[:3] + np.random.default_rng(5).normal(size=(3, 3)) * 0.02
    scene = scene.replace(camera_positions=CameraPositions(rows, xyz, diagonal_covariance(sigma)))
    result = groma.adjust(scene, groma.AdjustOptions(loss="none", point_sigma_px=0.3, line_sigma_px=0.3))
    plain, told = (pose_uncertainty(result.scene, result.problem, by_landmarks=by) for by in (False, True))
    assert told == plain and told["gauge"] == "measured" and "factor" not in told
    assert 0.005 < told["center"]["median"] < 0.05


def test_with_a_lens_that_is_estimated_and_a_robust_loss():
    scene = drawn(8, 0.5, np.random.default_rng(5), relations=False)
    result = groma.adjust(scene, groma.AdjustOptions(refine_intrinsics=True, point_sigma_px=0.5, line_sigma_px=0.5))
    assert {*result.problem.variables} > {"frames", "points", "lines"}
    numbers = pose_uncertainty(result.scene, result.problem, by_landmarks=True)
    assert 0.6 < numbers["factor"] < 1.6
    held = groma.adjust(scene, groma.AdjustOptions(refine_poses=False))
    assert pose_uncertainty(held.scene, held.problem, by_landmarks=True) is None


def test_it_has_the_same_bits_with_any_number_of_threads_of_the_linear_algebra():
    covariances = Covariances(observations_alone(assemble(holistic(58, 0).start, OPTIONS).problem))
    found = []
    for number in (1, 2):
        with threadpool_limits(number, user_api="blas"):
            found.append(landmark_jackknife(covariances)[1])
    assert np.array_equal(*found)
