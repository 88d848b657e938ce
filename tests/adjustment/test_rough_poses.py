# SPDX-License-Identifier: BSD-3-Clause
"""Poses, positions and distances that are known roughly, beside relations between landmarks, which are lengths and
would shrink the scene.
"""

import numpy as np
import pytest

import groma
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.survey.best_fit import best_fitted, moved
from groma.adjustment.survey.reliability import reliability
from groma.adjustment.terms.camera_poses import held_scale
from groma.adjustment.uncertainty import uncertainty
from groma.evaluation import evaluate_poses
from groma.factors import SegmentOnPlane
from groma.geometry import so3
from groma.problem.gauge import world_motions
from groma.scene import Similarity
from groma.scene.measurements import PosePriors
from groma.scene.survey import CameraPositions, Distances, Kind, KnownDirections, diagonal_covariance
from groma.scene.synthetic import holistic
from groma.solver.covariance.quantities import distance_between_cameras


def _at_poses(sigma):
    """A scene with planes at its true poses, whose centres are known to so many units and rotations to a radian."""
    truth = holistic(8, 3, noise_px=0.5).truth
    poses = truth.frames.rig_from_world
    priors = PosePriors(np.arange(len(poses)), poses, np.tile([sigma] * 3 + [1.0] * 3, (len(poses), 1)))
    return truth, truth.replace(pose_priors=priors)


@pytest.mark.kernels
def test_relations_do_not_shrink_a_scene_of_rough_poses():
    """By a thousandth at most; without the held scale it becomes a twelfth of its size."""
    truth, scene = _at_poses(5.0)
    found = groma.adjust(scene, groma.AdjustOptions(loss="none")).scene
    assert evaluate_poses(found, truth).alignment.scale == pytest.approx(1.0, abs=2e-3)


def test_exact_poses_determine_the_scale_themselves():
    for sigma, count in ((5.0, 1), (1e-4, None)):
        assert assemble(_at_poses(sigma)[1], AssemblyOptions()).num_measurements.get("held scale") == count


def _at_positions(sigma):
    """A scene with planes and measured positions of its cameras, at the truth."""
    truth = holistic(8, 3, noise_px=0.5).truth
    covariance = diagonal_covariance(np.full((truth.num_images, 3), sigma))
    return truth.replace(
        camera_positions=CameraPositions(np.arange(truth.num_images), truth.cam_centers_in_world, covariance)
    )


@pytest.mark.kernels
def test_relations_do_not_shrink_a_scene_of_rough_positions():
    """Without the held scale the adjustment shrinks it until it is stopped after 50 steps."""
    scene = _at_positions(5.0)
    result = groma.adjust(scene, groma.AdjustOptions(loss="none"))
    assert result.report.solve.converged and result.report.solve.iterations < 10
    assert "determine the scale to 35 %" in " ".join(result.report.warnings)
    assert "held scale" not in result.report.num_measurements
    np.testing.assert_allclose(result.scene.cam_centers_in_world, scene.cam_centers_in_world, atol=0.02)


@pytest.mark.parametrize(("part", "count"), [(0.1, 1), (1e-4, None)])
def test_distances_tell_the_scale_as_places_do(part, count):
    truth = holistic(8, 3, noise_px=0.5).truth
    apart = float(np.linalg.norm(truth.cam_centers_in_world[1] - truth.cam_centers_in_world[0]))
    scene = truth.replace(distances=Distances.between(Kind.IMAGE, 0, 1, [apart], [apart * part]))
    assert assemble(scene, AssemblyOptions()).num_measurements.get("held scale") == count
    assert assemble(_at_positions(5e3 * part), AssemblyOptions()).num_measurements.get("held scale") == 1
    assert assemble(_at_positions(1e-4), AssemblyOptions()).num_measurements.get("held scale") is None
    scaled = best_fitted(scene.transformed(groma.scene.Similarity(1.2), measured=False)).cam_centers_in_world
    assert np.linalg.norm(scaled[1] - scaled[0]) == pytest.approx(apart, rel=1e-6)


@pytest.mark.kernels
def test_the_held_scale_is_no_measurement_to_test():
    _, scene = _at_poses(5.0)
    down = KnownDirections([Kind.IMAGE], [0], [[0.0, 0.0, -1.0]], [[0.0, 1.0, 0.0]], [0.1])
    found = reliability(scene.replace(known_directions=down))
    assert found is not None and {one.kind for one in found.measurements} == {"known direction"}


def test_a_scene_is_placed_at_its_poses_which_stay():
    """Beside positions that know less, too: poses that moved with the scene would turn it by as much in each step."""
    _, scene = _at_poses(1.0)
    away = scene.transformed(groma.scene.Similarity(1.1, so3.exp(np.array([[0.1, 0.2, -0.1]]))[0], np.ones(3)))
    away = away.replace(pose_priors=scene.pose_priors)
    rough = _at_positions(50.0).camera_positions
    for one in (away, away.replace(camera_positions=rough)):
        np.testing.assert_allclose(best_fitted(one).cam_from_world, scene.cam_from_world, atol=1e-5)
        np.testing.assert_array_equal(best_fitted(one).pose_priors.rig_from_world, scene.pose_priors.rig_from_world)


@pytest.mark.kernels
def test_a_scene_is_placed_where_its_rough_poses_fit_best():
    """Pixels do not notice that it is turned and shifted as a whole, and rough poses weigh little beside them."""
    truth, scene = _at_poses(5.0)
    turned = scene.transformed(Similarity(1.0, so3.exp(np.array([[0.0, 0.02, 0.01]]))[0], np.array([0.3, 0.0, 0.1])))
    turned = turned.replace(pose_priors=scene.pose_priors)
    found = groma.adjust(turned, groma.AdjustOptions(loss="none", max_iterations=3)).scene
    off = best_fitted(found).cam_centers_in_world - found.cam_centers_in_world
    assert np.abs(off).max() < 1e-5
    np.testing.assert_allclose(found.cam_centers_in_world, truth.cam_centers_in_world, atol=0.02)
    held = groma.adjust(turned, groma.AdjustOptions(loss="none", max_iterations=3, refine_poses=False)).scene
    np.testing.assert_array_equal(held.frames.rig_from_world, turned.frames.rig_from_world)


def test_segments_on_planes_do_not_tell_where_a_scene_is():
    """Where it may move as a whole, the places on them move with it: a line askew would draw it along the line."""
    made = holistic(8, 3, noise_px=0.5)
    poses = made.start.frames.rig_from_world
    priors = PosePriors(np.arange(len(poses)), poses, np.tile([5.0] * 3 + [1.0] * 3, (len(poses), 1)))
    for scene, moves in ((made.start.replace(pose_priors=priors), True), (made.start, False)):
        problem = assemble(scene, AssemblyOptions()).problem
        (factor,) = (one for one in problem.factors if isinstance(one, SegmentOnPlane))
        assert (factor.frame is not None) is moves
        motions = {name: part.transpose(1, 2, 0) for name, part in world_motions(problem, np.zeros(3), 1.0).items()}
        told = np.abs(moved(motions, factor, problem)[:, :, :6]).max()
        assert told < 1e-10 if moves else told > 1e-3


@pytest.mark.kernels
@pytest.mark.parametrize("sigma", [0.5, 2.0])
def test_a_held_scale_is_as_uncertain_as_measurements_leave_it(sigma):
    """Positions with the deviation s at places x tell its logarithm to s / sqrt(sum |x - mean|^2), beside images that
    are far more exact; and what they tell of shift and turn is untouched.
    """
    scene = _at_positions(sigma)
    found = uncertainty(scene)
    assert found.gauge == "measured" and held_scale(found.covariances.problem) is not None
    centers = scene.cam_centers_in_world
    away = centers - centers.mean(axis=0)
    of_scale = sigma / np.sqrt(np.sum(away**2))
    for second in (3, 5):
        apart = distance_between_cameras(found.covariances, ("frames", 0), ("frames", second))
        assert apart.sigma == pytest.approx(of_scale * apart.value, rel=0.02)
    # Of each centre: a shift s / sqrt(n), turns by the inverse of their information, and the scale.
    turns = sigma**2 * np.linalg.inv(np.sum(away**2) * np.eye(3) - away.T @ away)
    hat = np.cross(away[:, None, :], np.eye(3)).swapaxes(1, 2)
    expected = sigma**2 / len(away) * np.eye(3) + hat @ turns @ np.swapaxes(hat, 1, 2)
    expected = expected + of_scale**2 * away[:, :, None] * away[:, None, :]
    np.testing.assert_allclose(found.centers, expected, atol=0.02 * sigma**2)
    places = found.covariances.of_coordinates("points")
    assert np.isfinite(places).all() and np.linalg.eigvalsh(places).min() > 0.0
