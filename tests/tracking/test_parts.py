# SPDX-License-Identifier: BSD-3-Clause
"""Parts of the tracker on their own: poses from a fixed map, planes and segments with depth, assignment, stereo."""

import dataclasses

import _room
import numpy as np
import pytest

from groma.factors.contract import Ref
from groma.factors.observations.plane_observation import PlaneObservation
from groma.features.depth.points import depth_at
from groma.features.point_tracks import corners, follow, spread
from groma.geometry import se3
from groma.scene.landmarks import Lines
from groma.tracking.frame.camera import TrackCamera, apart, back, into, planes_back, planes_into
from groma.tracking.frame.depth import segment_inverse_depths
from groma.tracking.frame.features import segment_noise
from groma.tracking.frame.measurements import LineMeasurements, Measurements, PlaneMeasurements, PointMeasurements
from groma.tracking.frame.planes import frame_planes
from groma.tracking.frame.sparse_depth import fill_sparse
from groma.tracking.frame.stereo import dense_disparities, match_right
from groma.tracking.gates import DEFAULT
from groma.tracking.map.landmarks import ALIVE, DEAD, SAMPLES_KEPT, LineTable, PlaneTable, PointTable
from groma.tracking.map.lines import assign, carried, line_ends
from groma.tracking.map.planes import add_planes, assign_planes, grow, merge_planes
from groma.tracking.map.track_map import TrackMap
from groma.tracking.map.triangulation import triangulate
from groma.tracking.pose.estimate import LOSSES, estimate_pose, rough_pose
from groma.tracking.pose.prediction import MotionModel
from groma.tracking.pose.relocalise import pose_from_matches

CAMERA = TrackCamera(500.0, 510.0, 320.0, 240.0, 640, 480, 0.2)
IDENTITY = np.array([0, 0, 0, 1, 0, 0, 0.0])
TRUE = se3.exp(np.array([[0.05, 0.02, -0.03, 0.02, -0.03, 0.01]]))[0]
WIDE = np.full(6, 0.5)


def _points(rng, count, noise=0.5):
    table = PointTable()
    table.extend(count)
    pixel = rng.uniform((20, 20), (620, 460), (count, 2))
    table.xyz[:] = CAMERA.bearings(pixel) * rng.uniform(1.5, 4.0, (count, 1))
    table.state[:] = ALIVE
    in_cam = into(TRUE, table.xyz)
    seen = CAMERA.project(in_cam) + noise * rng.normal(size=(count, 2))
    nothing = np.full(count, np.nan)
    measured = PointMeasurements(
        np.arange(count), seen, np.full(count, max(noise, 0.1)), nothing, nothing.copy(), np.full((count, 2), np.nan)
    )
    return table, measured


def _lines(rng, count):
    table = LineTable()
    table.extend(count)
    ends = np.stack([CAMERA.bearings(rng.uniform((20, 20), (620, 460), (count, 2))) for _ in (0, 1)], axis=1)
    table.segment[:] = ends * rng.uniform(1.5, 4.0, (count, 2, 1))
    table.plucker[:] = Lines.through(table.segment).plucker
    table.state[:] = ALIVE
    in_cam = into(TRUE, table.segment)
    seen = np.hstack([CAMERA.project(in_cam[:, 0]), CAMERA.project(in_cam[:, 1])])
    measured = LineMeasurements(
        np.arange(count), seen, np.full(count, 0.5), 1 / in_cam[..., 2], np.full((count, 2), 0.003)
    )
    return table, measured


def test_pose_from_points_with_outliers():
    rng = np.random.default_rng(0)
    table, measured = _points(rng, 200)
    measured.pixel[:40] += rng.uniform(20, 60, (40, 2))
    view = TrackMap(table, LineTable(), PlaneTable())
    empty = Measurements.empty()
    found = estimate_pose(CAMERA, view, Measurements(measured, empty.lines, empty.planes), IDENTITY, WIDE)
    # 160 points of half a pixel: below a tenth of a pixel, 0.2 mrad, and 0.5 mm at 2.5 units.
    assert np.abs(se3.log(se3.compose(found.pose[None], se3.inverse(TRUE[None])))).max() < 2e-3
    assert not found.points[:40].any()
    assert found.points[40:].mean() > 0.95
    assert found.weak == ()


def test_from_a_rough_pose_the_last_loss_leads_to_the_same_minimum():
    """Points with wrong matches among them, from 5 cm and 3 degrees away."""
    table, measured = _points(np.random.default_rng(3), 150)
    measured.pixel[:40] += np.random.default_rng(4).uniform(10, 60, (40, 2))
    view, empty = TrackMap(table, LineTable(), PlaneTable()), Measurements.empty()
    told = CAMERA, view, Measurements(measured, empty.lines, empty.planes), IDENTITY, WIDE
    rough = rough_pose(*told, IDENTITY)
    assert np.abs(se3.log(se3.compose(rough[None], se3.inverse(TRUE[None])))).max() < 0.01
    found, whole = estimate_pose(*told, rough, LOSSES[-1:]), estimate_pose(*told)
    np.testing.assert_allclose(found.pose, whole.pose, atol=1e-4)
    np.testing.assert_array_equal(found.points, whole.points)


def test_points_weigh_by_their_own_noise():
    """The information of the points of a noisy frame is less by the square of their standard deviation."""
    table, measured = _points(np.random.default_rng(0), 100, noise=0.2)
    view, empty = TrackMap(table, LineTable(), PlaneTable()), Measurements.empty()
    noisy = dataclasses.replace(measured, sigma=3 * measured.sigma)
    first, second = (
        estimate_pose(CAMERA, view, Measurements(table, empty.lines, empty.planes), IDENTITY, WIDE).information
        for table in (measured, noisy)
    )
    # Weights fall with residuals, which are a third in units of the larger noise: by a few per cent.
    assert np.trace(first) / np.trace(second) == pytest.approx(9.0, rel=0.25)


def test_pose_from_lines_alone():
    table, measured = _lines(np.random.default_rng(1), 30)
    view, empty = TrackMap(PointTable(), table, PlaneTable()), Measurements.empty()
    found = estimate_pose(CAMERA, view, Measurements(empty.points, measured, empty.planes), IDENTITY, WIDE)
    assert np.abs(se3.log(se3.compose(found.pose[None], se3.inverse(TRUE[None])))).max() < 1e-4
    assert found.lines.all()


def test_one_wall_leaves_three_directions_to_the_prior():
    planes = PlaneTable()
    planes.extend(1)
    planes.hesse[0], planes.state[0] = [0, 0, -1, 2.0], ALIVE
    seen = planes_into(TRUE, planes.hesse)
    measured = PlaneMeasurements(np.zeros(1, np.int64), seen, np.diag([200.0, 200.0, 200.0])[None])
    view, empty = TrackMap(PointTable(), LineTable(), planes), Measurements.empty()
    found = estimate_pose(CAMERA, view, Measurements(empty.points, empty.lines, measured), IDENTITY, WIDE)
    assert sorted(found.weak) == ["turn about z", "x", "y"]
    assert np.abs(planes_into(found.pose, planes.hesse) - seen).max() < 1e-4
    # What the wall does not tell stays as predicted.
    assert np.abs(se3.log(found.pose[None])[0, [0, 1, 5]]).max() < 0.01


def test_planes_of_a_depth_image_and_their_noise():
    """A corner of three planes; the errors of normals and offsets are what their information says, or less."""
    camera = TrackCamera.of(_room.camera())
    pose = se3.inverse(se3.exp(np.array([[0.3, 0.2, 0.2, 0.5, 0.7, 0.1]])))[0]
    depth = _room.render(pose)[1]
    rng = np.random.default_rng(2)
    noisy = (depth + 0.002 * depth**2 * rng.normal(size=depth.shape)).astype(np.float32)
    found = frame_planes(camera, noisy, 10.0)
    assert len(found) == 3
    world = planes_back(pose, found.plane)
    for hesse in world:
        axis = int(np.abs(hesse[:3]).argmax())
        assert abs(hesse[axis]) > np.cos(0.01)
        assert abs(hesse[3] - _room.ROOM[axis]) < 0.02
    assert (found.plane[:, 3] > 0).all()
    # In the basis of the factor, whose rows are sines of angles and the offset.
    none = np.zeros(3, np.int64)
    basis = PlaneObservation(pose=Ref("p", none), plane=Ref("q", none), planes_in_cam=found.plane).basis
    axes = np.abs(world[:, :3]).argmax(axis=1)
    true = np.zeros((3, 4))
    true[np.arange(3), axes] = np.sign(world[np.arange(3), axes])
    true[:, 3] = _room.ROOM[axes]
    true = planes_into(pose, true)
    error = np.column_stack([np.einsum("kia,ki->ka", basis, true[:, :3]), true[:, 3] - found.plane[:, 3]])
    whitened = np.einsum("kab,kb->ka", found.sqrt_information, error)
    assert np.sqrt((whitened**2).mean()) < 1.5
    assert len(frame_planes(camera, np.zeros_like(noisy), 10.0)) == 0


def test_planes_are_assigned_by_angle_distance_and_overlap():
    camera = TrackCamera.of(_room.camera())
    pose = se3.inverse(se3.exp(np.array([[0.3, 0.2, 0.2, 0.5, 0.7, 0.1]])))[0]
    found = frame_planes(camera, _room.render(pose)[1], 10.0)
    table = PlaneTable()
    index = add_planes(table, found, np.arange(len(found)), pose)
    near = se3.compose(se3.exp(np.array([[0.02, 0, 0, 0, 0.03, 0]])), pose[None])[0]
    again = frame_planes(camera, _room.render(near)[1], 10.0)
    gates = dataclasses.replace(DEFAULT.planes, angle=0.1, distance=0.1)
    first, second = assign_planes(table, again, pose, gates)
    assert len(first) == len(again) == 3
    assert np.abs((table.hesse[first, :3] * planes_back(near, again.plane[second])[:, :3]).sum(1)).min() > 0.999
    # The same plane far away from what was seen is another one.
    table.samples[index] += 5.0
    assert len(assign_planes(table, again, pose, gates)[0]) == 0


def test_planes_merge_when_they_lie_on_each_other():
    table = PlaneTable()
    table.extend(3)
    table.hesse[:] = [[0, 0, 1, -2.0], [0, 0.01, 0.99995, -2.01], [0, 0, 1, -2.3]]
    table.state[:], table.found[:], table.support[:] = ALIVE, 1, [100, 50, 70]
    places = np.array([[x, y, 2.0] for x in (0, 0.2) for y in (0, 0.2)])
    table.samples[:, :4] = places
    table.samples[2, :4, 2] = 2.3
    assert merge_planes(table) == [(0, 1)]
    assert table.state.tolist() == [ALIVE, DEAD, ALIVE]
    assert table.merged_into[1] == 0


def test_depth_of_pixels_and_segments():
    depth = np.full((60, 80), 2.0, np.float32)
    depth[:, 40:] = 1.0
    depth[:10] = 0
    found = depth_at(depth, np.array([[20.5, 30.5], [60.5, 30.5], [40.0, 30.5], [20.5, 5.5]]), 5.0)
    assert found[0] == 2.0
    assert found[1] == 1.0
    assert np.isnan(found[2:]).all()
    # An edge between two surfaces belongs to the nearer one; where nothing is known, nothing is told.
    ends = np.array([[40.0, 20, 40.0, 50.0], [10.0, 5.0, 30.0, 5.0]])
    inverse, sigma = segment_inverse_depths(depth, ends, CAMERA.params, segment_noise())
    assert np.abs(inverse[0] - 1.0).max() < 1e-6
    assert (sigma[0] < 0.01).all()
    assert np.isnan(inverse[1]).all()


def test_a_plane_keeps_one_sample_of_each_box():
    rng, table, gates = np.random.default_rng(4), PlaneTable(), DEFAULT.planes
    table.extend(1)
    for count in (20, 300):
        before = table.samples[0][np.isfinite(table.samples[0][:, 0])]
        places = rng.uniform((-3.0, -0.5, -1e-3), (3.0, 0.5, 1e-3), (count, 3))
        grow(table, 0, places, 1.0, gates)
        both, size = np.concatenate([before, places]), gates.box
        while len({tuple(cell) for cell in np.floor(both / size).tolist()}) > SAMPLES_KEPT:
            size *= gates.box_growth
        first = {}
        for place in both.tolist():
            first.setdefault(tuple(np.floor(np.array(place) / size).tolist()), place)
        kept = table.samples[0][np.isfinite(table.samples[0][:, 0])]
        np.testing.assert_array_equal(kept, [first[cell] for cell in sorted(first)])
    assert size > gates.box


def test_holes_between_samples_of_a_plane_are_filled():
    rng = np.random.default_rng(8)
    u, v = np.meshgrid(np.arange(160), np.arange(120))
    whole = (1.0 / (0.4 + 0.001 * u - 0.0005 * v)).astype(np.float32)
    whole[:, 100:] = 1.0
    sparse = np.where(rng.random(whole.shape) < 0.9, 0, whole).astype(np.float32)
    filled = fill_sparse(sparse, 6.0)
    new = (sparse == 0) & (filled > 0)
    assert new.mean() > 0.4
    assert np.abs(1 / filled[new] - 1 / whole[new]).max() < 1e-3
    assert (filled[sparse > 0] == sparse[sparse > 0]).all()
    # Nothing is read across the step, and dense images stay as they are.
    assert not new[:, 92:108].any()
    assert fill_sparse(whole, 6.0) is whole


def test_segments_are_assigned_one_to_one():
    expected = np.array([[100, 100, 200, 100], [100, 110, 200, 110], [300, 50, 300, 150.0]])
    seen = expected[[2, 0, 1]] + 1.5
    rows, hits = assign(expected, seen, 5.0, 0.1)
    assert sorted(zip(rows.tolist(), hits.tolist(), strict=True)) == [(0, 1), (1, 2), (2, 0)]
    # The dark side on the other hand is another edge, and so is another depth.
    assert len(assign(expected, seen[:, [2, 3, 0, 1]], 5.0, 0.1)[0]) == 0
    depth = np.array([0.5, 0.5, 0.5])
    assert len(assign(expected, seen, 5.0, 0.1, depth, 2 * depth)[0]) == 0


def test_segments_carried_by_flow():
    flow = np.zeros((60, 80, 2), np.float32)
    flow[..., 0], flow[..., 1] = 6.0, -2.0
    flow[:, 50:] = 40.0
    ends = np.array([[20, 100, 120, 60.0]])
    there, good = carried(flow, ends, (120, 160))
    assert good.all()
    assert np.abs(there - ends - [6, -2, 6, -2]).max() < 1e-6


def test_ends_of_lines_lie_on_lines_and_rays():
    table, measured = _lines(np.random.default_rng(5), 20)
    ends, good = line_ends(CAMERA, TRUE, table.plucker, measured.ends)
    assert np.abs(ends - table.segment)[good].max() < 1e-6
    assert good.sum() >= 19


def test_segments_are_clipped_to_the_image():
    ends = np.array([[[-5, 0, 2], [5, 0, 2.0]], [[0, 0, -1], [0, 0.4, 1.0]], [[0, 0, -1], [1, 0, -2.0]]])
    seen, good = CAMERA.project_segments(ends)
    assert good.tolist() == [True, True, False]
    assert np.allclose(seen[0], [0, 240, 640, 240])
    assert (seen[1] >= 0).all()


def test_clipped_segments_are_what_is_seen_of_them():
    rng = np.random.default_rng(4)
    ends = rng.uniform((-4.0, -4.0, -3.0), (4.0, 4.0, 5.0), (400, 2, 3))
    found, seen = CAMERA.project_segments(ends, border=5.0)
    share = np.linspace(0.0, 1.0, 20_001)[:, None]
    near = 0.02 * np.median(np.abs(ends[..., 2]))
    for segment, pixels, is_seen in zip(ends, found, seen, strict=True):
        along = segment[0] + share * (segment[1] - segment[0])
        along = along[along[:, 2] >= near]
        at = CAMERA.project(along)
        at = at[CAMERA.inside(at, 5.0)]
        if len(at) < 2:
            assert not is_seen or np.hypot(*(pixels[2:] - pixels[:2])) < 2.0
            continue
        assert is_seen
        # Steps of the samples are wider near the camera.
        np.testing.assert_allclose(
            pixels, np.concatenate([at[0], at[-1]]), atol=1.0 + np.abs(np.diff(at, axis=0)).max()
        )
    assert 40 < seen.sum() < 300


def test_cameras_are_apart_by_the_way_between_them_and_the_turn():
    rng = np.random.default_rng(5)
    for size in (1e-9, 1e-4, 0.3, 3.0):
        pose = se3.exp(rng.normal(size=(1, 6)))[0]
        omega = rng.normal(size=3)
        omega *= size / np.linalg.norm(omega)
        other = se3.compose(se3.exp(np.concatenate([rng.normal(size=3), omega])[None]), pose[None])[0]
        centers = se3.inverse(np.stack([pose, other]))[:, 4:]
        shift, turn = apart(pose, other)
        assert shift == pytest.approx(np.linalg.norm(centers[1] - centers[0]), rel=1e-12)
        assert turn == pytest.approx(size, rel=1e-12, abs=1e-15)


def test_triangulation():
    rng = np.random.default_rng(6)
    table, measured = _points(rng, 50, noise=0.0)
    first = np.tile(IDENTITY, (50, 1))
    places, good = triangulate(CAMERA, first, CAMERA.project(table.xyz), TRUE, measured.pixel)
    assert np.abs(places - table.xyz)[good].max() < 1e-6
    assert good.mean() > 0.5


def test_pose_from_matches_with_outliers():
    rng = np.random.default_rng(7)
    table, measured = _points(rng, 60)
    measured.pixel[:20] = rng.uniform(0, 400, (20, 2))
    pose, agree = pose_from_matches(CAMERA, table.xyz, measured.pixel)
    assert np.abs(pose - TRUE).max() < 0.01
    assert agree[20:].mean() > 0.9
    assert pose_from_matches(CAMERA, table.xyz[:3], measured.pixel[:3]) is None


def test_stereo_columns():
    left, depth = _room.render(IDENTITY)
    right = _room.render(np.array([0, 0, 0, 1, -_room.BASELINE, 0, 0]))[0]
    pixel = corners(left, 200, 8.0)
    pixel = pixel[(pixel[:, 0] > 40) & (pixel[:, 0] < 300)]
    row, column = pixel[:, 1].astype(int), pixel[:, 0].astype(int)
    expected = pixel[:, 0] - _room.FOCAL * _room.BASELINE / depth[row, column]
    found = match_right(left, right, pixel, np.full(len(pixel), np.nan), dense_disparities(left, right))[:, 0]
    known = np.isfinite(found)
    assert known.mean() > 0.6
    assert np.median(np.abs(found - expected)[known]) < 0.15
    near = match_right(left, right, pixel, expected + 0.5, None)[:, 0]
    assert np.nanmedian(np.abs(near - expected)) < 0.15


def test_points_follow_a_shift():
    image = _room.render(IDENTITY)[0]
    moved = np.roll(image, (3, 5), axis=(0, 1))
    pixel = corners(image, 100, 8.0)
    pixel = pixel[(pixel.min(axis=1) > 20) & (pixel[:, 0] < 290) & (pixel[:, 1] < 210)]
    there, good = follow(image, moved, pixel)
    assert good.mean() > 0.9
    assert np.median(np.abs(there[good] - pixel[good] - [5, 3])) < 0.05
    assert len(follow(image, moved, np.zeros((0, 2)))[0]) == 0


def test_points_are_spread():
    pixel = np.array([[5, 5], [6, 6], [50, 50], [52, 52], [90, 10.0]])
    chosen = spread(pixel, np.array([1, 2, 3, 4, 5.0]), np.array([[95, 12.0]]), (100, 100), 10, cell=20)
    assert chosen.tolist() == [3, 1]


def test_constant_velocity_bridges_missing_frames():
    model, step = MotionModel(), se3.exp(np.array([[0.1, 0, 0, 0, 0.02, 0]]))
    pose, before = IDENTITY, None
    for k in range(4):
        model.predict(pose if before is None else before, k / 30)
        model.update(before, pose, k / 30)
        before, pose = pose, se3.compose(step, pose[None])[0]
    expected = se3.compose(step, pose[None])[0]
    predicted, sigma = model.predict(before, 5 / 30)
    assert np.abs(predicted - expected).max() < 1e-9
    assert (sigma > 0).all()


@pytest.mark.parametrize("count", [1, 64, 200])
def test_tables_grow(count):
    table = PointTable()
    rows = [table.extend(count) for _ in range(3)]
    table.xyz[rows[1]] = 1.0
    assert len(table) == 3 * count
    assert table.xyz.sum() == 3 * count
    assert not table.alive.any()


def test_planes_move_there_and_back():
    planes = np.array([[0, 0.6, 0.8, 1.5]])
    assert np.allclose(planes_back(TRUE, planes_into(TRUE, planes)), planes)
    place = np.array([[0.3, 0.9, -2.55]])
    assert np.allclose(back(TRUE, into(TRUE, place)), place)
