# SPDX-License-Identifier: BSD-3-Clause
"""Measurements of any object: distances, known planes and directions, poses with covariance, and what is held.

Truth is that of made scenes with lines and planes; distances and heights are computed here by plain geometry.
"""

from dataclasses import replace

import numpy as np
import pytest
from _survey import ELSEWHERE, SIGMA, control, control_file, made, measured_positions, on_rigs, positions

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.assemble import assemble, first_camera_gauge
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.diagnosis import diagnose_scene
from groma.adjustment.survey.attach import with_survey
from groma.adjustment.survey.given import Survey
from groma.adjustment.survey.place import settled
from groma.adjustment.survey.reliability import reliability
from groma.adjustment.terms.open_motions import coordinates_to_hold
from groma.adjustment.uncertainty import position_sigma
from groma.errors import InputError
from groma.geometry import incidence, line3, quaternion, se3, so3
from groma.io.survey import DirectionsFile, DistancesFile, PlanesFile, PosesFile
from groma.problem.residuals import residuals_of
from groma.scene import (
    CameraPoses,
    Directions,
    Distances,
    Held,
    KnownDirections,
    KnownPlanes,
    PosePriors,
    Similarity,
)
from groma.scene.survey import Kind
from groma.scene.synthetic.noise import project_pinhole
from groma.scene.synthetic.scenes import holistic

LEAST_SQUARES = AdjustOptions(loss="none", point_sigma_px=0.5, check_lens=False)
DOWN = np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module")
def truth():
    """A scene with points, lines and planes, and four control points."""
    scene = holistic(8, noise_px=0.5, seed=1).truth
    points, marks, xyz = control(scene, np.random.default_rng(2), 4, 0)
    return scene.replace(control_points=points.replace(xyz=xyz, role=np.zeros(4, int)), marks=marks)


def of_line(scene, row, place):
    """The distance of a place from a line, by its segment."""
    first, second = scene.lines.segments[row]
    along = (second - first) / np.linalg.norm(second - first)
    return np.linalg.norm(place - first - ((place - first) @ along) * along)


def residuals(scene, kind):
    """Residuals of the factors of one type at a scene."""
    problem = assemble(scene, AssemblyOptions()).problem
    return np.concatenate([residuals_of(f, problem.variables) for f in problem.factors if f.type_name == kind])


def test_distances_between_objects_of_every_kind(truth):
    """Names are found, kinds are put in order, and the residuals of true distances are zero."""
    centers, plane, line = truth.cam_centers_in_world, truth.planes.hesse[0], 3
    p0, middle = truth.control_points.xyz[0], truth.lines.segments[5].mean(axis=0)
    lines = truth.lines.plucker.copy()
    along = quaternion.rotate(quaternion.exp(np.array([0.03, 0.0, 0.03])), lines[line, 3:])  # two degrees from parallel
    lines[5] = line3.from_point_and_direction(middle, along)
    truth = truth.replace(lines=truth.lines.replace(plucker=lines))
    near = truth.points.xyz[4]
    rows = [
        ("00001.png", "00004.png", np.linalg.norm(centers[3] - centers[0])),
        ("p0", "00002.png", np.linalg.norm(centers[1] - p0)),
        (f"line:{truth.lines.ids[line]}", "p0", of_line(truth, line, p0)),
        ("00003.png", f"line:{truth.lines.ids[line]}", of_line(truth, line, centers[2])),
        (f"line:{truth.lines.ids[5]}", f"line:{truth.lines.ids[line]}", of_line(truth, line, middle)),
        (f"plane:{truth.planes.ids[0]}", "p0", abs(plane[:3] @ p0 + plane[3])),
        ("00003.png", f"plane:{truth.planes.ids[0]}", abs(plane[:3] @ centers[2] + plane[3])),
        (f"point:{truth.points.ids[4]}", "p0", np.linalg.norm(near - p0)),
    ]
    first, second, distance = zip(*rows, strict=True)
    given = DistancesFile(first, second, np.array(distance), np.full(len(rows), np.nan), "bars.csv")
    found = with_survey(truth, Survey(distances=given, distance_sigma=1e-3))
    assert found.similarity.scale == pytest.approx(1.0, abs=1e-9)
    scene, table = found.scene, found.scene.distances
    assert (table.first_kind <= table.second_kind).all() and len(table) == len(rows)
    # the scene point has become a control point, marked where it was observed
    assert scene.num_points == truth.num_points - 1 and scene.control_points.names[-1] == f"point:{truth.points.ids[4]}"
    assert (truth.point_observations.point_idx == 4).sum() == (scene.marks.point_idx == 4).sum() > 1
    there = np.vstack([truth.control_points.xyz, near])
    off = residuals(scene.replace(control_points=scene.control_points.replace(xyz=there)), "distance")
    np.testing.assert_allclose(off, 0.0, atol=1e-9)


def gravity_file(scene, rng, sigma_deg=0.5, world=DOWN):
    """Where down is in the cameras of a scene whose world has it at ``world``."""
    turn = scene.cam_from_world[:, :4]
    seen = quaternion.rotate(turn, np.tile(world, (len(turn), 1)))
    seen = quaternion.rotate(quaternion.exp(rng.normal(size=(len(turn), 3)) * np.radians(sigma_deg)), seen)
    count = len(seen)
    return DirectionsFile(scene.images.names, seen, np.tile(DOWN, (count, 1)), np.full(count, sigma_deg), "imu.txt")


def test_distances_of_objects_that_are_not_parallel(truth):
    """Of two lines it is the shortest, wherever that is, and told; what has none, or no side, is refused."""
    lines, ids, plane = truth.lines.plucker, truth.lines.ids, f"plane:{truth.planes.ids[0]}"
    pairs = incidence.closest_points(lines[:1], lines)
    other = int(np.argmax(pairs.distance * (pairs.sine > 0.5)))
    apart, angle = pairs.distance[other], np.degrees(np.arcsin(pairs.sine[other]))
    assert apart > 0.1

    def given(first, second, distance, sigma):
        return DistancesFile((first,), (second,), np.array([distance]), np.array([sigma]), "bars.csv")

    one, two = f"line:{ids[0]}", f"line:{ids[other]}"
    found = with_survey(truth, Survey(distances=given(one, two, 1.25 * apart, 0.001)))
    assert any(f"{one} and {two} are {angle:.0f} degrees from parallel" in note for note in found.notes)
    assert found.similarity.scale == pytest.approx(1.25) and found.scene.distances.is_shortest.all()
    np.testing.assert_allclose(residuals(found.scene, "distance"), 0.0, atol=1e-9)
    slid = found.scene.replace(distances=found.scene.distances.replace(anchor=[[9.0, -5.0, 3.0]]))
    np.testing.assert_allclose(residuals(slid, "distance"), 0.0, atol=1e-9)
    with pytest.raises(InputError, match="does not say on which side"):
        with_survey(truth, Survey(distances=given(one, two, apart, apart / 3)))
    across = int(np.argmax(np.abs(lines[:, 3:] @ truth.planes.hesse[0, :3])))
    with pytest.raises(InputError, match="they meet, so they have no distance"):
        with_survey(truth, Survey(distances=given(f"line:{ids[across]}", plane, 1.0, 0.001)))
    marks = DistancesFile(("p0", "00001.png"), ("p1", plane), np.ones(2), np.ones(2), "bars.csv")
    assert not any("parallel" in note for note in with_survey(truth, Survey(distances=marks)).notes)


def test_what_a_ring_of_distances_determines_is_said(truth):
    """Every control point is tied to another one: none can be eliminated on its own."""
    start = truth.points_only()
    xyz, ends = truth.control_points.xyz, np.arange(4)
    lengths = np.linalg.norm(xyz[(ends + 1) % 4] - xyz, axis=1)
    ring = Distances.between(Kind.CONTROL_POINT, ends, (ends + 1) % 4, lengths, np.full(4, 1e-3))
    found = diagnose_scene(start.replace(distances=ring))
    assert found.num_free_motions == 6 and found.num_unobservable_directions == 0


def test_gravity_turns_a_scene_and_holds_it(truth):
    """Two of eight phones are wrong: the scene is level all the same, and they are named."""
    rng = np.random.default_rng(4)
    given = gravity_file(truth, rng)
    for wrong in (1, 6):
        given.vectors[wrong] = quaternion.rotate(quaternion.exp(np.array([0.2, 0.0, 0.1])), given.vectors[wrong])
    found = with_survey(truth.transformed(ELSEWHERE), Survey(directions=given))
    up = found.scene.planes.hesse[:, 2]
    assert np.abs(np.abs(up) - np.abs(truth.planes.hesse[:, 2])).max() < np.radians(1.0)
    assert any("turned by" in note for note in found.notes) and found.similarity.scale == 1.0
    result = adjust(found.scene, LEAST_SQUARES)
    tests = reliability(result.scene, result.problem)
    named = {one.name for one in tests.suspects}
    assert {"00002.png", "00007.png"} <= named and tests.suspects[0].name in ("00002.png", "00007.png")
    assert {one.kind for one in tests.measurements} >= {"known direction"}
    one = next(one for one in tests.measurements if one.name == "00001.png" and one.kind == "known direction")
    assert one.sigma == pytest.approx(0.5) and one.coordinate == "a"  # degrees


def rolls(count):
    """Turns about the optical axis, phones held upright and on their side."""
    angle = np.random.default_rng(0).uniform(-1.5, 1.5, count)
    return se3.exp(np.column_stack([np.zeros((count, 5)), angle]))


def test_axes_of_phones_are_checked(truth):
    given = gravity_file(truth, np.random.default_rng(4))
    turned = given.vectors @ np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]).T
    with pytest.raises(InputError, match="axes turned by 90 degrees"):
        with_survey(truth, Survey(directions=replace(given, vectors=turned)))
    with pytest.raises(InputError, match="contradict their poses"):
        with_survey(truth, Survey(directions=replace(given, vectors=given.vectors[[3, 0, 5, 1, 7, 2, 4, 6]])))
    rolled = truth.with_poses(se3.compose(rolls(8), truth.cam_from_world))
    opengl = gravity_file(rolled, np.random.default_rng(4))
    with pytest.raises(InputError, match="OpenGL"):
        with_survey(rolled, Survey(directions=replace(opengl, vectors=opengl.vectors * [1, -1, -1])))
    upward = DirectionsFile(given.names, -given.vectors, given.in_world, given.sigma_deg, "imu.txt")
    one = np.array([[0.0, 0.0, -1.0]])
    sky = DirectionsFile(given.names[:1], one, one, given.sigma_deg[:1], "imu.txt")
    ground = replace(sky, vectors=-one)  # of a camera that looks straight down
    for file, told in ((upward, True), (given, False), (sky, True), (ground, False)):
        notes = with_survey(truth, Survey(directions=file)).notes
        assert any("Accelerometers measure up" in note for note in notes) == told


def test_lines_have_known_directions(truth):
    """A scene of another frame is turned until two lines run as they were measured, either way round."""
    known = truth.lines.plucker[[3, 7], 3:] * [[1.0], [-1.0]]
    names = tuple(f"line:{truth.lines.ids[row]}" for row in (3, 7))
    given = DirectionsFile(names, known, np.tile(DOWN, (2, 1)), np.full(2, np.nan), "lines.txt")
    turn = np.append(se3.exp(np.array([[0.5, 1.0, 20.0, 0.3, -0.5, 0.2]]))[0], 1.0)
    found = with_survey(truth.transformed(turn), Survey(directions=given, direction_sigma_deg=0.2))
    result = adjust(found.scene, LEAST_SQUARES)
    along = np.abs(np.einsum("ni,ni->n", result.scene.lines.plucker[[3, 7], 3:], known))
    assert along.min() > np.cos(np.radians(0.5))
    with pytest.raises(InputError, match="--direction-sigma"):
        with_survey(truth, Survey(directions=given))


def test_known_planes_lift_and_turn(truth):
    """Three control points and a plane of the scene at known heights."""
    floor = int(np.argmax(np.abs(truth.planes.hesse[:, 2])))
    normal, offset = truth.planes.hesse[floor, :3], truth.planes.hesse[floor, 3]
    names = ("p0", "p1", "p2", f"plane:{truth.planes.ids[floor]}", "00001.png")
    heights = np.append(truth.control_points.xyz[:3] @ normal, [-offset, truth.cam_centers_in_world[0] @ normal])
    given = PlanesFile(names, np.column_stack([np.tile(normal, (5, 1)), -heights]), np.full(5, 0.002), "levels.txt")
    far = se3.exp(np.array([[0.5, 1.0, 20.0, 0.02, -0.03, 0.0]]))[0]
    moved = truth.transformed(np.append(far, 1.0))
    found = with_survey(moved, Survey(planes=given))
    table = found.scene.known_planes
    assert table.kind.tolist() == [Kind.CONTROL_POINT] * 3 + [Kind.PLANE] * 3 + [Kind.IMAGE]
    result = adjust(found.scene, LEAST_SQUARES)
    after = result.scene
    np.testing.assert_allclose(after.control_points.xyz[:3] @ normal, heights[:3], atol=0.01)
    plane = after.planes.hesse[floor] * np.sign(after.planes.hesse[floor, :3] @ normal)
    np.testing.assert_allclose(plane, truth.planes.hesse[floor], atol=0.02)
    tests = reliability(after, result.problem)
    assert tests.redundancy["known plane"] > 0.5 and len(tests.suspects) == 0


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


def test_a_scene_settles_where_all_measurements_fit(truth):
    """A similarity away from where it was measured in several ways it goes back, measurements staying."""
    rng = np.random.default_rng(0)
    scene = truth.replace(camera_positions=positions(truth, rng, 1e-9))
    scene = with_survey(scene, Survey(directions=gravity_file(truth, rng, 1e-6))).scene
    twist = np.array([0.05, 0.1, -0.02, np.sqrt(1 - 0.0129), 0.3, -0.2, 0.1, 1.1])
    back = settled(scene.transformed(twist, measured=False))
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


def test_gravity_with_turned_signs_beside_positions_is_named(truth):
    rng = np.random.default_rng(4)
    places = measured_positions(truth, rng)
    given = gravity_file(truth, rng)
    assert with_survey(truth, Survey(positions=places, directions=given)).alignment is not None
    turned = replace(given, vectors=-given.vectors)
    with pytest.raises(InputError, match="the signs turned"):
        with_survey(truth, Survey(positions=places, directions=turned))
