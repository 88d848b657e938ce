# SPDX-License-Identifier: BSD-3-Clause
"""Planes in the points and lines of a map: exact scenes of one camera and of stereo pairs, and what is no plane.

The camera of the exact scenes has 500 pixels of focal length and looks at things about 5 units away, so that a pixel is
a centimetre; its noise is a quarter of that.
"""

import dataclasses

import _room
import numpy as np
import pytest

import groma
from groma.adjustment.assemble import assemble
from groma.geometry import quaternion, se3
from groma.scene import Cameras, PointObservations, Points, RightColumns, Scene, Similarity
from groma.tracking import Tracker, TrackOptions
from groma.tracking.backend.local_adjustment import job_of
from groma.tracking.backend.plane_outcome import PlaneOutcome, drop_what_failed
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.map.landmark_planes import find_planes
from groma.tracking.map.landmarks import ALIVE
from groma.tracking.map.track_map import TrackMap
from groma.tracking.result import map_to_scene

pytestmark = pytest.mark.filterwarnings("error")
FOCAL, SIGMA, BASELINE = 500.0, 0.25, 0.3
#: A floor 1.5 units below the first camera: y points down.
FLOOR = np.array([0.0, 1.0, 0.0, -1.5])


def _floor(count, rng):
    return np.column_stack([rng.uniform(-2, 2, count), np.full(count, 1.5), rng.uniform(4, 7, count)])


def _cloud(count, rng):
    return np.column_stack([rng.uniform(-2, 2, count), rng.uniform(-1, 1.5, count), rng.uniform(4, 7, count)])


def _scene(xyz, rng, stereo=False, views=6):
    """Points seen by cameras that move sideways and down, with noise; pairs see them in the right image, too."""
    poses = se3.identity(views)
    poses[:, 4], poses[:, 5] = -np.linspace(0, 1.5, views), -np.linspace(0, 0.5, views)
    params = np.array([FOCAL, FOCAL, 320.0, 240.0])
    image, point = (grid.ravel() for grid in np.meshgrid(np.arange(views), np.arange(len(xyz)), indexing="ij"))
    in_cam = quaternion.rotate(poses[image, :4], xyz[point]) + poses[image, 4:]
    pixel = FOCAL * in_cam[:, :2] / in_cam[:, 2:] + params[2:] + SIGMA * rng.normal(size=(len(image), 2))
    noise = SIGMA / FOCAL * in_cam[: len(xyz), 2:] ** 2 * [0.2, 0.2, 1.0] / np.sqrt(views)
    cameras = Cameras(np.array([1]), ("PINHOLE",), params[None], np.array([640]), np.array([480]))
    more = {}
    if stereo:
        right = FOCAL * (in_cam[:, 0] - BASELINE) / in_cam[:, 2] + params[2] + SIGMA * rng.normal(size=len(image))
        more["right_columns"] = RightColumns(np.arange(len(image)), right, np.full(len(image), BASELINE))
    scene = Scene.from_images(
        cameras, [f"{k}" for k in range(views)], np.zeros(views, int), poses,
        points=Points(
            np.arange(len(xyz)) + 1, xyz + noise * rng.normal(size=xyz.shape),
            np.zeros((len(xyz), 3), np.uint8), np.zeros(len(xyz)),
        ),
        point_observations=PointObservations.numbered(image, point, pixel, np.ones(len(image))),
        **more,
    )  # fmt: skip
    return groma.adjust(scene, groma.AdjustOptions(refine_poses=False, loss="none", check_lens=False)).scene


def _map_of(scene):
    """A map with the points of a scene."""
    out = TrackMap()
    rows = out.points.extend(scene.num_points)
    out.points.xyz[rows], out.points.state[rows] = scene.points.xyz, ALIVE
    return out


@pytest.mark.parametrize("stereo", [False, True])
def test_a_floor_among_other_things_is_found(stereo):
    rng = np.random.default_rng(0)
    scene = _scene(np.concatenate([_floor(120, rng), _cloud(120, rng)]), rng, stereo)
    track_map = _map_of(scene)
    assert find_planes(track_map, scene) == 1
    hesse = track_map.planes.hesse[0] * np.sign(track_map.planes.hesse[0, 1])
    assert hesse[1] > np.cos(np.radians(0.5))
    assert hesse[3] == pytest.approx(FLOOR[3], abs=0.03)
    on = track_map.points.plane == 0
    assert on[:120].mean() > 0.6
    assert on[120:].mean() < 0.1
    # The floor is exact: what its points may deviate from it is below their own noise.
    assert 0 < np.median(track_map.points.plane_sigma[on]) < SIGMA / FOCAL * 6


def _first_keyframe_only(scene, points):
    """The scene with some points seen by the first camera alone."""
    table = scene.point_observations
    rows = np.flatnonzero((table.image_idx == 0) | ~np.isin(table.point_idx, points))
    columns = {"right_columns": scene.right_columns.take(rows)} if len(scene.right_columns) else {}
    if columns:
        columns["right_columns"] = columns["right_columns"].replace(observation_idx=np.arange(len(rows)))
    return scene.replace(point_observations=table.take(rows), **columns)


def test_points_of_one_stereo_pair_help_to_find_a_floor():
    """Disparities tell where points are that a single pair saw. One camera does not know where such points are."""
    rng = np.random.default_rng(1)
    xyz = np.concatenate([_floor(120, rng), _cloud(60, rng)])
    planes = []
    for stereo, often in ((True, 12), (False, 0)):
        scene = _first_keyframe_only(_scene(xyz, rng, stereo), np.arange(often, 120))
        track_map = _map_of(scene)
        planes.append(find_planes(track_map, scene))
        # What takes no part in adjustments is not tied to the plane.
        assert (track_map.points.plane[12:120] == -1).all()
    assert planes == [1, 0]


@pytest.mark.parametrize("shape", ["cloud", "line", "few", "nothing"])
def test_what_is_no_plane(shape):
    rng = np.random.default_rng(2)
    xyz = _cloud(250, rng)
    if shape == "line":
        xyz = np.array([-1.0, 0.5, 4.0]) + rng.uniform(0, 3, (150, 1)) * [0.6, 0.1, 0.7]
    scene = _scene(xyz[: {"few": 3}.get(shape)], rng) if shape != "nothing" else Scene()
    track_map = _map_of(scene)
    assert find_planes(track_map, scene) == 0
    assert (track_map.points.plane == -1).all()
    assert len(track_map.planes) == 0


def test_the_unit_of_length_changes_nothing():
    rng = np.random.default_rng(3)
    scene = _scene(np.concatenate([_floor(100, rng), _cloud(100, rng)]), rng)
    maps = []
    for factor in (1.0, 1000.0):
        other = scene.transformed(Similarity(factor))
        maps.append(_map_of(other))
        assert find_planes(maps[-1], other) == 1
    small, large = maps
    np.testing.assert_array_equal(large.points.plane, small.points.plane)
    np.testing.assert_allclose(large.points.plane_sigma, 1000.0 * small.points.plane_sigma, rtol=1e-5)
    np.testing.assert_allclose(large.planes.hesse, small.planes.hesse * [1, 1, 1, 1000.0], rtol=1e-5, atol=1e-6)


def test_rough_ground_is_one_plane_and_says_how_rough():
    """Two pixels of relief: planes that are flat to a fifth of a pixel are not what is there."""
    rng = np.random.default_rng(4)
    xyz = np.concatenate([_floor(300, rng), _cloud(100, rng)])
    xyz[:300, 1] += 0.02 * rng.normal(size=300)
    scene = _scene(xyz, rng)
    track_map = _map_of(scene)
    assert find_planes(track_map, scene) == 1
    sigma = np.median(track_map.points.plane_sigma[track_map.points.plane == 0])
    # Only what the tests take for the plane tells, so the estimate falls short; 0.02 is the truth.
    assert 0.01 < sigma < 0.03


def test_looking_again_forgets_what_was_found_before():
    rng = np.random.default_rng(5)
    scene = _scene(_floor(150, rng), rng)
    track_map = _map_of(scene)
    find_planes(track_map, scene)
    find_planes(track_map, scene)
    assert track_map.planes.alive.sum() == 1
    assert set(np.unique(track_map.points.plane)) <= {-1, 1}


# ------------------------------------------------------------------------------------------------- whole sequences


@pytest.fixture(scope="module")
def truth():
    return _room.poses(24)


def _run(frames, camera, **options):
    tracker = Tracker(camera, TrackOptions(num_points=250, num_features=500, **options))
    for frame in frames:
        tracker.process(frame)
    return tracker, tracker.finish()


@pytest.fixture(scope="module")
def stereo(truth):
    return _run(_room.frames("stereo", truth[:16]), _room.camera(_room.BASELINE))


@pytest.fixture(scope="module")
def mono(truth):
    return _run(_room.frames("mono", truth), _room.camera())


def _walls_of(scene, scale=1.0):
    """How far planes are from the walls of the room: degrees, and units at the middle of the room."""
    angle, offset = [], []
    for hesse in scene.planes.hesse:
        axis = int(np.argmax(np.abs(hesse[:3])))
        hesse = hesse * np.sign(hesse[3])
        angle.append(np.degrees(np.arccos(abs(hesse[axis]))))
        offset.append(abs(scale * hesse[3] - _room.ROOM[axis]))
    return np.array(angle), np.array(offset)


def test_walls_by_a_stereo_pair(stereo, truth):
    _, result = stereo
    scene = result.scene
    angle, offset = _walls_of(scene)
    assert len(angle) >= 1
    assert angle.max() < 2.0
    assert offset.max() < 0.05
    numbers = result.statistics["landmark_planes"]
    assert numbers["held"] == result.statistics["planes"] == scene.num_planes
    assert numbers["points"] == len(scene.relations.point_on_plane) > 30
    assert numbers["lines"] == len(scene.relations.line_on_plane)
    assert f"{numbers['points']:,} points" in numbers["sentence"]
    # The scene is the problem that tracking ended with: nothing is left to do.
    again = groma.adjust(scene).report
    assert again.solve.iterations == 0
    assert again.relations["point_on_plane"] == {"held": numbers["points"], "dropped": 0}
    assert _room.position_error(result.trajectory, truth) < 0.02
    assert not result.warnings


def test_walls_by_one_camera(mono, truth):
    """The world is that of the first camera; its unit comes from the path."""
    _, result = mono
    path, true = (np.ptp(x[:, 4:], axis=0) for x in (result.trajectory.world_from_cam, se3.inverse(truth)))
    angle, offset = _walls_of(result.scene, float(np.linalg.norm(true) / np.linalg.norm(path)))
    assert len(angle) >= 1
    assert angle.max() < 3.0
    assert offset.max() < 0.15
    assert not result.statistics["metric"]
    assert _room.position_error(result.trajectory, truth, scale=True) < 0.02


def test_the_unit_of_a_map_of_one_camera_is_held(mono):
    """Distances from planes cost less in a smaller map: beside the first keyframe one coordinate is held."""
    tracker = mono[0]
    living = tracker.map.living()
    held = np.arange(len(living)) == 0
    constant = []
    for relations in (True, False):
        job = job_of(tracker.map, TrackCamera.of(_room.camera()), living, held, relations)
        assert job is not None
        constant.append(np.asarray(assemble(job.scene, job.options).problem.variables["frames"].constant))
    assert constant[0].sum() == 7
    assert constant[0][0].all()
    np.testing.assert_array_equal(constant[1], held)


def test_without_planes(truth):
    """Switched off there are none, and nothing is said; too few points, and that is said."""
    frames = _room.frames("stereo", truth[:14])
    _, off = _run(frames, _room.camera(_room.BASELINE), planes=False)
    assert off.scene.num_planes == 0
    assert "landmark_planes" not in off.statistics
    _, none = _run(frames, _room.camera(_room.BASELINE), lines=False, gates=_asking_for(10_000))
    assert none.scene.num_planes == 0
    assert none.statistics["landmark_planes"]["sentence"].startswith("No planes: none stands out from the ")


def _asking_for(support):
    gates = TrackOptions().gates
    return dataclasses.replace(gates, landmark_planes=dataclasses.replace(gates.landmark_planes, min_support=support))


def test_landmarks_that_do_not_hold_leave_their_plane(stereo):
    tracker, camera = stereo[0], TrackCamera.of(_room.camera(_room.BASELINE))
    track_map = tracker.map.copy()
    planes, points = track_map.planes, track_map.points
    plane = int(np.argmax(np.where(planes.alive, planes.support, 0)))
    on = np.flatnonzero(points.plane == plane)
    before = len(map_to_scene(track_map, camera).relations.point_on_plane)
    points.plane_sigma[on[:3]] *= 1e-6
    points.xyz[on[:3]] += 0.1 * planes.hesse[plane, :3]
    assert drop_what_failed(track_map, camera) == (3, 0)
    assert (points.plane[on[:3]] == -1).all()
    assert len(map_to_scene(track_map, camera).relations.point_on_plane) == before - 3
    # A plane that most leave is none.
    planes.hesse[plane, 3] += 0.5
    assert drop_what_failed(track_map, camera)[1] == 1
    assert not planes.alive[plane]
    assert not (points.plane == plane).any()


def test_sentences():
    assert "did not hold" in PlaneOutcome((10, 2), 0, 1, 0, dropped=8).sentence
    told = PlaneOutcome((10, 2), 4, 1, 1, 9, 2, 1).sentence
    assert "1 landmark contradicted" in told
    assert "10 points (4 of them in one keyframe alone, which are not written) and 2 lines" in told
