# SPDX-License-Identifier: BSD-3-Clause
"""Measured poses with covariances: they place a scene, are tested, and may be written in other conventions."""

import numpy as np
import pytest
from _survey import ELSEWHERE, SIGMA, control_file, made, measured_positions, on_rigs
from _survey_objects import DOWN, LEAST_SQUARES, residuals, with_control

from groma.adjustment.adjust import adjust
from groma.adjustment.survey.attach import with_survey
from groma.adjustment.survey.given import Survey
from groma.adjustment.survey.reliability import reliability
from groma.errors import InputError
from groma.geometry import quaternion, se3
from groma.io.survey import PosesFile
from groma.scene import CameraPoses, Held, KnownDirections, KnownPlanes, PosePriors


@pytest.fixture(scope="module")
def truth():
    return with_control()


def measured_poses(scene, rng, center=0.02, degrees=0.3):
    """A file of poses with correlated noise, and its covariance in the axes of the world."""
    count = scene.num_images
    mix = np.eye(6) + 0.4 * np.triu(np.ones((6, 6)), 1)
    root = mix * np.repeat([center, np.radians(degrees)], 3)[:, None]
    noise = rng.normal(size=(count, 6)) @ root.T
    world = se3.inverse(scene.cam_from_world)
    turned = quaternion.multiply(quaternion.exp(noise[:, 3:]), world[:, :4])
    rows = np.hstack([scene.cam_centers_in_world + noise[:, :3], turned])
    return PosesFile(scene.images.names, rows, np.tile(root @ root.T, (count, 1, 1)), "poses.txt")


def test_errors_of_poses_are_those_of_their_covariance(truth):
    """The covariance in the axes of the world becomes one in those of each camera."""
    squares = []
    for draw in range(40):
        given = measured_poses(truth, np.random.default_rng(draw))
        table = with_survey(truth.replace(held=Held([0], [0])), Survey(poses=given)).scene.camera_poses
        twist = se3.log(se3.compose(truth.cam_from_world[table.image_idx], se3.inverse(table.cam_from_world)))
        squares.append(np.einsum("ni,nij,nj->n", twist, np.linalg.inv(table.covariance), twist))
    # 320 squares of chi-square 6: the mean has a standard deviation of 0.19
    assert np.mean(squares) == pytest.approx(6.0, abs=0.8)


def test_poses_place_a_scene_and_wrong_ones_are_named(truth):
    given = measured_poses(truth, np.random.default_rng(3))
    given.world_from_cam[4, 0] += 0.5
    found = with_survey(truth.transformed(ELSEWHERE), Survey(poses=given))
    assert np.abs(found.scene.cam_centers_in_world - truth.cam_centers_in_world).max() < 0.1
    assert any("into the frame of the measured poses" in note for note in found.notes)
    result = adjust(found.scene, LEAST_SQUARES)
    tests = reliability(result.scene, result.problem)
    assert tests.suspects[0].name == "00005.png" and tests.suspects[0].kind == "camera pose"
    rows = [one for one in tests.measurements if one.name == "00001.png" and one.kind == "camera pose"]
    assert [one.coordinate for one in rows] == ["x", "y", "z", "turn x", "turn y", "turn z"]
    off = np.delete(result.scene.cam_centers_in_world - truth.cam_centers_in_world, 4, axis=0)
    assert np.sqrt((off**2).mean()) < 0.02
    with pytest.raises(InputError, match="--pose-sigma"):
        with_survey(truth, Survey(poses=PosesFile(given.names, given.world_from_cam, given.covariance * np.nan, "p")))


def test_poses_of_cameras_on_rigs():
    scene = on_rigs(made()[0])
    table = CameraPoses(np.arange(8), scene.cam_from_world, np.tile(np.eye(6), (8, 1, 1)))
    np.testing.assert_allclose(residuals(scene.replace(camera_poses=table), "pose_prior"), 0.0, atol=1e-12)
    down = quaternion.rotate(scene.cam_from_world[:, :4], np.tile(DOWN, (8, 1)))
    of_images = np.zeros(8, int), np.arange(8)
    gravity = KnownDirections(*of_images, np.tile(DOWN, (8, 1)), down, np.full(8, 0.01))
    heights = np.column_stack([np.tile([0, 0, 1.0], (8, 1)), -scene.cam_centers_in_world[:, 2]])
    planes = KnownPlanes(*of_images, np.zeros((8, 3)), heights, np.full(8, 0.01))
    both = scene.replace(known_directions=gravity, known_planes=planes)
    np.testing.assert_allclose(residuals(both, "camera_direction"), 0.0, atol=1e-7)
    np.testing.assert_allclose(residuals(both, "on_known_plane"), 0.0, atol=1e-12)


@pytest.mark.parametrize("same", [True, False])
def test_given_poses_beside_control_points(truth, same):
    """In the frame of the control points they go on weighing; in another one they have done their work."""
    scene = made()[0]
    start = scene if same else scene.transformed(ELSEWHERE)
    count = scene.num_frames
    priors = PosePriors(np.arange(count), start.frames.rig_from_world, np.full((count, 6), 0.05))
    given, xyz = control_file(scene, np.random.default_rng(2))
    found = with_survey(start.replace(pose_priors=priors), Survey(control=given, control_sigma=(SIGMA,)))
    assert len(found.scene.pose_priors) == (count if same else 0)
    assert any(("already" if same else "in another frame") in note for note in found.notes)
    after = adjust(found.scene, LEAST_SQUARES).scene
    assert np.abs(after.control_points.xyz - xyz).max() < 3 * SIGMA
    positioned = Survey(positions=measured_positions(scene, np.random.default_rng(1)))
    by_positions = with_survey(start.replace(pose_priors=priors), positioned)
    assert len(by_positions.scene.pose_priors) == (count if same else 0)


def test_poses_whose_noise_is_known_replace_estimated_ones(truth):
    priors = PosePriors(np.arange(8), truth.frames.rig_from_world, np.full((8, 6), 0.05))
    given = Survey(poses=measured_poses(truth, np.random.default_rng(3)))
    found = with_survey(truth.replace(pose_priors=priors), given).scene
    assert len(found.pose_priors) == 0 and len(found.camera_poses) == 8


@pytest.mark.parametrize(
    ("written", "words"),
    [
        (lambda t, q, c: (c, quaternion.multiply(q, np.array([[1.0, 0.0, 0.0, 0.0]]))), "the axes of OpenGL"),
        (lambda t, q, c: (c, q[:, [3, 0, 1, 2]]), "begin with qw"),
        (lambda t, q, c: (t, quaternion.conjugate(q)), "are of the world in the camera"),
        (lambda t, q, c: (c, quaternion.multiply(q, np.array([[0.5, -0.5, 0.5, 0.5]]))), "the axes of a vehicle"),
    ],
)
def test_poses_that_are_written_in_another_way_are_named(truth, written, words):
    """As they should be the scene is brought to them, whatever its frame; else one line says how they are written."""
    turn = quaternion.conjugate(truth.cam_from_world[:, :4])
    shift, centers = truth.cam_from_world[:, 4:], truth.cam_centers_in_world

    def given(places, turns):
        covariance = np.tile(np.diag(np.repeat([1e-4, 1e-4], 3)), (len(turn), 1, 1))
        return Survey(poses=PosesFile(truth.images.names, np.hstack([places, turns]), covariance, "poses.txt"))

    start = truth.points_only().transformed(ELSEWHERE)
    found = with_survey(start, given(centers, turn))
    np.testing.assert_allclose(found.scene.cam_centers_in_world, centers, atol=1e-6)
    with pytest.raises(InputError, match=words):
        with_survey(start, given(*written(shift, turn, centers)))
