# SPDX-License-Identifier: BSD-3-Clause
"""What measurements and held objects leave open, and that no more than that is held for the gauge."""

from dataclasses import replace

import numpy as np
import pytest
from _survey import control, positions
from _survey_objects import LEAST_SQUARES, gravity_file, with_control

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.assemble import first_camera_gauge
from groma.adjustment.survey.attach import with_survey
from groma.adjustment.survey.best_fit import best_fitted
from groma.adjustment.survey.given import Survey
from groma.adjustment.terms.open_motions import coordinates_to_hold
from groma.adjustment.uncertainty import position_sigma
from groma.errors import InputError
from groma.geometry import so3
from groma.io.survey import PlanesFile
from groma.scene import Directions, Distances, Held, KnownPlanes, Similarity
from groma.scene.survey import Kind
from groma.scene.synthetic.noise import project_pinhole
from groma.scene.synthetic.scenes import holistic


@pytest.fixture(scope="module")
def truth():
    return with_control()


def test_what_is_held_keeps_its_place(truth):
    lines, image = truth.lines.ids[[2, 4]], truth.images.names[5]
    start = holistic(8, noise_px=0.5, seed=1).start
    given = Survey(hold=(image, f"line:{lines[0]}", f"point:{start.points.ids[7]}", f"plane:{start.planes.ids[0]}"))
    found = with_survey(start, given)
    after = adjust(found.scene, LEAST_SQUARES).scene
    frame = start.images.frame_idx[5]
    assert np.array_equal(after.frames.rig_from_world[frame], start.frames.rig_from_world[frame])
    np.testing.assert_allclose(after.lines.plucker[2], start.lines.plucker[2], atol=1e-12)
    assert np.array_equal(after.points.xyz[7], start.points.xyz[7])
    np.testing.assert_allclose(after.planes.hesse[0], start.planes.hesse[0], atol=1e-12)
    assert np.abs(after.frames.rig_from_world[frame - 1] - start.frames.rig_from_world[frame - 1]).max() > 1e-4
    assert sorted(with_survey(start, Survey(hold=("*3.png", "00001.png"))).scene.held.idx.tolist()) == [0, 2]
    with pytest.raises(InputError, match=r"neither a control point nor an image.*nearest: 0000\d\.png"):
        with_survey(start, Survey(hold=("0000l.png",)))


def test_measurements_in_another_frame_than_held_objects_are_refused(truth):
    """They would pull the scene to pieces; positions that are merely rough are not in another frame."""
    scene = holistic(8, noise_px=0.5, seed=1).start
    there = positions(truth, np.random.default_rng(0), 1e-3)
    held = Survey(hold=(scene.images.names[5],))
    assert with_survey(scene.replace(camera_positions=there), held).scene.held.idx.tolist() == [5]
    utm = there.replace(xyz=there.xyz + np.array([5e5, 5e6, 0.0]))
    with pytest.raises(InputError, match=r"parts of it are held\. The measured places are 5.02e\+06 away .* frame"):
        with_survey(scene.replace(camera_positions=utm), held)
    rough = utm.replace(covariance=np.tile(1e13 * np.eye(3), (len(utm), 1, 1)))
    with_survey(scene.replace(camera_positions=rough), held)


def test_a_scene_settles_where_all_measurements_fit(truth):
    """A similarity away from where it was measured in several ways it goes back, measurements staying."""
    rng = np.random.default_rng(0)
    scene = truth.replace(camera_positions=positions(truth, rng, 1e-9))
    scene = with_survey(scene, Survey(directions=gravity_file(truth, rng, 1e-6))).scene
    twist = np.array([0.05, 0.1, -0.02, np.sqrt(1 - 0.0129), 0.3, -0.2, 0.1, 1.1])
    back = best_fitted(scene.transformed(twist, measured=False))
    np.testing.assert_allclose(back.cam_centers_in_world, truth.cam_centers_in_world, atol=1e-6)
    assert np.array_equal(back.camera_positions.xyz, scene.camera_positions.xyz)


@pytest.mark.parametrize(("kinds", "open_"), [("g", 5), ("h", 3), ("gh", 3), ("gd", 4), ("i", 1), ("ii", 0)])
def test_what_measurements_leave_open_is_held_and_nothing_else(truth, kinds, open_):
    """Gravity leaves shifts, heading and scale; heights shifts aside and heading; two held cameras nothing."""
    rng, scene = np.random.default_rng(0), truth
    if "g" in kinds:
        scene = with_survey(scene, Survey(directions=gravity_file(scene, rng))).scene
    heights = np.column_stack([np.tile([0, 0, 1.0], (8, 1)), -truth.cam_centers_in_world[:, 2]])
    if "h" in kinds:
        planes = PlanesFile(truth.images.names, heights, np.full(8, 0.01), "levels.txt")
        scene = with_survey(truth, Survey(planes=planes)).scene.replace(known_directions=scene.known_directions)
    if "d" in kinds:
        scene = scene.replace(distances=Distances.between(Kind.IMAGE, 0, 1, [1.0], [0.1]))
    if "i" in kinds:
        scene = truth.replace(held=Held(np.zeros(len(kinds), int), np.arange(len(kinds))))
    held = coordinates_to_hold(scene, np.ones(8, bool))
    assert held.sum() == open_


@pytest.mark.parametrize(
    ("kind", "count", "open_"),
    [
        (Kind.POINT, 1, 4), (Kind.CONTROL_POINT, 1, 4), (Kind.CONTROL_POINT, 2, 1), (Kind.CONTROL_POINT, 3, 0),
        (Kind.LINE, 1, 3), (Kind.LINE, 3, 0), (Kind.PLANE, 1, 4), (Kind.DIRECTION, 1, 5), (Kind.DIRECTION, 2, 4),
    ],
)  # fmt: skip
def test_what_held_landmarks_leave_open(truth, kind, count, open_):
    """A place leaves turns and scale, two the turn about their line; a line a shift, a turn and a scale, two more none,
    if they do not meet.
    """
    directions = Directions(np.arange(2), np.eye(3)[:2])
    scene = truth.replace(directions=directions, held=Held(np.full(count, kind), np.arange(count)))
    assert coordinates_to_hold(scene, np.ones(8, bool)).sum() == open_


def test_measurements_that_are_rejected_leave_the_gauge_alone(truth):
    planes = PlanesFile(truth.images.names, np.tile([0, 0, 1.0, -1.0], (8, 1)), np.full(8, 0.01), "levels.txt")
    scene = with_survey(truth, Survey(planes=planes)).scene
    scene = scene.replace(known_planes=scene.known_planes.replace(rejected=np.ones(8, bool)))
    assert np.array_equal(first_camera_gauge(scene), first_camera_gauge(scene.replace(known_planes=KnownPlanes())))


@pytest.mark.parametrize("kind", [Kind.CONTROL_POINT, Kind.LINE, Kind.PLANE])
def test_held_landmarks_alone_hold_the_scene(kind):
    """A scene that begins a similarity away from what is held of it goes there; no camera is held against that."""
    scene = holistic(8, noise_px=0.0, seed=1).truth
    points, marks, xyz = control(scene, np.random.default_rng(2), 4, 0)
    poses = scene.cam_from_world[marks.image_idx]
    marks = marks.replace(pixel=project_pinhole(scene.cameras.params[0], poses, xyz[marks.point_idx])[0])
    scene = scene.replace(control_points=points.replace(xyz=xyz, role=np.zeros(4, int)), marks=marks)
    turn = so3.exp(np.array([[0.01, -0.02, 0.015]]))[0]
    start = scene.transformed(Similarity(1.01, turn, np.array([0.03, -0.02, 0.02])))
    name = {Kind.CONTROL_POINT: "control_points", Kind.LINE: "lines", Kind.PLANE: "planes"}[kind]
    table = getattr(scene, name)
    start = start.replace(**{name: table, "held": Held(np.full(len(table), kind), np.arange(len(table)))})
    result = adjust(start, replace(LEAST_SQUARES, max_iterations=100))
    assert result.report.solve.final_cost < 1e-6 * result.report.solve.initial_cost
    if kind != Kind.PLANE:  # three planes meet in a point, from where the scene may have any size
        np.testing.assert_allclose(result.scene.cam_centers_in_world, scene.cam_centers_in_world, atol=1e-3)


def test_gravity_keeps_the_size_of_a_scene():
    """Relations between landmarks cost less in a smaller scene, which gravity does not prevent."""
    made_ = holistic(12, noise_px=0.5, seed=1)
    found = with_survey(made_.start, Survey(directions=gravity_file(made_.truth, np.random.default_rng(0))))
    told = AdjustOptions(loss="none", point_sigma_px=0.5, line_sigma_px=0.5, check_lens=False)
    result = adjust(found.scene, told)
    size = [np.linalg.norm(one.cam_centers_in_world.std(axis=0)) for one in (result.scene, made_.truth)]
    assert size[0] == pytest.approx(size[1], rel=0.03) and result.report.solve.iterations < 20
    spread = result.uncertainty()
    assert spread.gauge == "inner" and position_sigma(spread.centers).max() < 0.03
