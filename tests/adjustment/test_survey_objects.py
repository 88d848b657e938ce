# SPDX-License-Identifier: BSD-3-Clause
"""Distances between objects of any kind, known directions and known planes.

Truth is that of made scenes with lines and planes; distances and heights are computed here by plain geometry.
"""

from dataclasses import replace

import numpy as np
import pytest
from _survey import ELSEWHERE, measured_positions
from _survey_objects import DOWN, LEAST_SQUARES, gravity_file, residuals, with_control

from groma.adjustment.adjust import adjust
from groma.adjustment.diagnosis import diagnose_scene
from groma.adjustment.survey.attach import with_survey
from groma.adjustment.survey.given import Survey
from groma.adjustment.survey.reliability import reliability
from groma.errors import InputError
from groma.geometry import incidence, line3, quaternion, se3
from groma.io.survey import DirectionsFile, DistancesFile, PlanesFile
from groma.scene import Distances
from groma.scene.survey import Kind


@pytest.fixture(scope="module")
def truth():
    return with_control()


def of_line(scene, row, place):
    """The distance of a place from a line, by its segment."""
    first, second = scene.lines.segments[row]
    along = (second - first) / np.linalg.norm(second - first)
    return np.linalg.norm(place - first - ((place - first) @ along) * along)


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


def test_gravity_with_turned_signs_beside_positions_is_named(truth):
    rng = np.random.default_rng(4)
    places = measured_positions(truth, rng)
    given = gravity_file(truth, rng)
    assert with_survey(truth, Survey(positions=places, directions=given)).alignment is not None
    turned = replace(given, vectors=-given.vectors)
    with pytest.raises(InputError, match="the signs turned"):
        with_survey(truth, Survey(positions=places, directions=turned))
