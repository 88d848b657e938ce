# SPDX-License-Identifier: BSD-3-Clause
"""Stereo pairs whose right camera is turned: rows, columns, maps that are corrected, and a whole track.

Turns are made by rendering, or by projecting points into a right camera that is turned by a known rotation.
"""

import math
from dataclasses import replace

import _room
import cv2
import numpy as np
import pytest

from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import RightTurnPrior
from groma.adjustment.terms.right_columns import RIGHT_CAMERAS
from groma.errors import InputError
from groma.geometry import quaternion, se3, so3
from groma.problem.residuals import residuals_of
from groma.tracking import Tracker
from groma.tracking.backend.stereo_calibration import correct_map, estimate_turn, shift_between
from groma.tracking.frame.camera import TrackCamera, into
from groma.tracking.frame.features import Features
from groma.tracking.frame.measurements import Measurements, PointMeasurements
from groma.tracking.frame.rectification import (
    RightTurn,
    are_exchanged,
    find_pairs,
    fit_rows,
    retargeted,
    rows_turned_back,
    turned_disparities,
    turned_pixels,
)
from groma.tracking.gates import RectificationGates
from groma.tracking.map.landmarks import ALIVE
from groma.tracking.map.map_scene import TRACKING
from groma.tracking.map.track_map import Keyframe, TrackMap
from groma.tracking.options import TrackOptions
from groma.tracking.result import map_to_scene

CAMERA = TrackCamera(700.0, 710.0, 600.0, 185.0, 1220, 370, 0.54)
GATES = RectificationGates()
#: Pitch, yaw and roll, radians.
TURN = np.array([0.5 / 710, 1.2 / 700, -0.7 / 610])
NONE = np.zeros(3)
#: Covariance of a yaw that is known to 0.07 pixels, so that followed points may tell it.
KNOWN = 1e-8 * np.eye(3)


def _exp(angles):
    return so3.exp(angles[None])[0]


def _pairs(rng, count, turn, noise):
    """Points seen by both cameras, with noise in the right image."""
    left = rng.uniform((60, 20), (1160, 350), (count, 2))
    rectified = left - np.column_stack([rng.uniform(2, 60, count), np.zeros(count)])
    return left, turned_pixels(CAMERA, rectified, _exp(turn)) + noise * rng.normal(size=(count, 2))


@pytest.mark.parametrize("keystone_px", [0.0, 6.0])
def test_rows_tell_pitch_and_roll(keystone_px):
    """Normalised errors of two angles over 40 draws; a keystone, as of wrong principal points, is none of theirs."""
    total = 0.0
    for seed in range(40):
        left, right = _pairs(np.random.default_rng(seed), 400, TURN, 0.2)
        ray = CAMERA.bearings(right)
        right[:, 1] += keystone_px * ray[:, 0] * ray[:, 1]
        right[::10, 1] += 4.0  # wrong matches
        angles, information = fit_rows(CAMERA, left, right)
        error = (angles - TURN)[[0, 2]]
        total += error @ information[np.ix_([0, 2], [0, 2])] @ error
        assert not information[1].any() and angles[1] == 0.0
    # chi-square of 80 degrees of freedom: 46 to 126 but for one in a thousand; the covariance is of 24 samples.
    assert 40.0 < total < 160.0


def test_too_few_rows_tell_nothing():
    left, right = _pairs(np.random.default_rng(0), GATES.min_pairs - 1, TURN, 0.1)
    assert not fit_rows(CAMERA, left, right)[1].any()
    known = RightTurn.unknown().joined(NONE, np.zeros((3, 3)))
    np.testing.assert_allclose(np.sqrt(np.diag(known.covariance)), np.radians(GATES.sigma_deg))


def test_pixels_and_disparities_turned_back():
    left, right = _pairs(np.random.default_rng(1), 50, TURN, 0.0)
    there = retargeted(CAMERA, right, NONE, TURN)
    np.testing.assert_allclose(there[:, 1], left[:, 1], atol=1e-9)
    np.testing.assert_allclose(retargeted(CAMERA, there, TURN, NONE), right, atol=1e-9)
    # Dense disparities: those of the columns as they are in the image, at pixels of the left image.
    dense = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    at = left.astype(int)
    middle = at + 0.5
    disparity = (left - there)[:, 0]
    raw = turned_pixels(CAMERA, middle - np.column_stack([disparity, np.zeros(50)]), _exp(TURN))
    dense[at[:, 1], at[:, 0]] = middle[:, 0] - raw[:, 0]
    turned = turned_disparities(CAMERA, dense, TURN)[at[:, 1], at[:, 0]]
    np.testing.assert_allclose(turned, disparity, atol=0.01)


@pytest.mark.parametrize("turn", [TURN, -4.0 * TURN])
def test_a_pair_of_images_is_put_into_rows(turn):
    """A wall with a relief seen by a right camera that is turned, by up to 5 px in row; then no row differs."""
    rng = np.random.default_rng(2)
    left = cv2.GaussianBlur(120 + 200 * rng.normal(size=(CAMERA.height, CAMERA.width)), (0, 0), 2.0)
    left = np.clip(left, 0, 255).astype(np.uint8)
    u, v = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    # The right image at p shows what the left one shows a disparity of 12 px to the right of where p is rectified.
    there = retargeted(CAMERA, np.column_stack([u.ravel(), v.ravel()]), NONE, turn).reshape(*u.shape, 2)
    right = cv2.remap(
        left, (there[..., 0] + 11.5).astype(np.float32), (there[..., 1] - 0.5).astype(np.float32), cv2.INTER_CUBIC
    )
    here, found = find_pairs(CAMERA, left, right)
    assert len(here) > 300
    angles, information = fit_rows(CAMERA, here, found)
    assert information.any()
    np.testing.assert_allclose((angles - turn)[[0, 2]] * [710, 610], 0.0, atol=0.05)
    aligned = rows_turned_back(CAMERA, right, turn)
    here, found = find_pairs(CAMERA, left, aligned)
    assert np.abs(np.median((found - here)[:, 1])) < 0.03
    assert np.percentile(np.abs(found - here)[:, 1], 80) < 0.15


@pytest.mark.parametrize("shift", [-12, 0, 12, 40])
def test_exchanged_images_are_told(shift):
    """Of a wall; a shift within what the right camera may be turned (6 px) tells nothing."""
    wall = cv2.GaussianBlur(120 + 200 * np.random.default_rng(2).normal(size=(370, 1300)), (0, 0), 2.0)
    wall = np.clip(wall, 0, 255).astype(np.uint8)
    left, right = (np.ascontiguousarray(wall[:, begin : begin + 1220]) for begin in (20, 20 + shift))
    assert are_exchanged(CAMERA, left, right) == (shift < 0)
    assert are_exchanged(CAMERA, right, left) == (shift > 0)
    assert not are_exchanged(CAMERA, left, np.full_like(left, 90))


def test_a_track_of_exchanged_images_ends_at_once():
    frames = [replace(one, gray=one.right, right=one.gray) for one in _room.frames("stereo", _room.poses(2))]
    tracker = Tracker(_room.camera(_room.BASELINE))
    with pytest.raises(InputError, match="seem to be exchanged"):
        tracker.process(*frames)


# ------------------------------------------------------------------------------------------------------------- maps


def _map(seed, turn, assumed=NONE, noise=0.3, keyframes=7, as_depths=False):
    """A drive of 1 m a keyframe past points 4 to 40 m away; right pixels are turned back by assumed angles.

    Every second one may be kept as the depth that it gives, as those of described features are.
    """
    rng = np.random.default_rng(seed)
    places = np.column_stack([rng.uniform(-12, 12, 700), rng.uniform(-3, 3, 700), rng.uniform(6, 45, 700)])
    track_map, points = TrackMap(), None
    points = track_map.points
    points.extend(len(places))
    points.xyz[:], points.state[:], points.first_keyframe[:] = places, ALIVE, 0
    for k in range(keyframes):
        pose = np.array([0, math.sin(0.01 * k), 0, math.cos(0.01 * k), 0.02 * k, 0, -float(k)])
        at = into(pose, places)
        pixel = CAMERA.project(at)
        rows = np.flatnonzero((at[:, 2] > 3) & CAMERA.inside(pixel, 5))
        pixel = pixel[rows] + noise * rng.normal(size=(len(rows), 2))
        right = CAMERA.project((at[rows] - [CAMERA.baseline, 0, 0]) @ _exp(turn).T)
        right = retargeted(CAMERA, right + noise * rng.normal(size=right.shape), NONE, assumed)
        depth = CAMERA.fx * CAMERA.baseline / (pixel - right)[:, 0]
        depth[(np.arange(len(rows)) % 2 == 0) | (not as_depths) | (depth < 0)] = np.nan
        right[np.isfinite(depth)] = np.nan
        sigma = 0.5 * depth**2 / (CAMERA.fx * CAMERA.baseline)
        table = PointMeasurements(rows, pixel, np.ones(len(rows)), depth, sigma, right)
        measured = replace(Measurements.empty(), points=table)
        track_map.keyframes.append(
            Keyframe(k, float(k), f"{k}.png", pose, None, measured, Features.none(), np.zeros(0), 20.0)
        )
    return track_map, places


@pytest.mark.parametrize(("assumed", "as_depths"), [(NONE, False), (TURN, False), (-TURN, False), (-TURN, True)])
def test_a_map_tells_all_three_angles(assumed, as_depths):
    """Whatever they were turned back by: to a tenth of a pixel, and yaw within its standard deviation."""
    total = 0.0
    for seed in range(4):
        track_map, _ = _map(seed, TURN, assumed, as_depths=as_depths)
        before = RightTurn(assumed, KNOWN)
        turn, job = estimate_turn(track_map, CAMERA, before, TrackOptions())
        assert job is not None
        error = turn.angles - TURN
        total += error[1] ** 2 / turn.covariance[1, 1]
        np.testing.assert_allclose(error * [710, 700, 610], 0.0, atol=0.12)
        assert shift_between(CAMERA, before, turn) == pytest.approx(
            shift_between(CAMERA, before, RightTurn(TURN, np.eye(3))), abs=0.25
        )
    assert total < 18.5  # chi-square of 4 degrees of freedom, one in a thousand


def test_a_camera_that_stands_tells_no_yaw():
    """Without motion a wrong yaw is a wrong depth: it stays as uncertain as before."""
    track_map, _ = _map(0, TURN, keyframes=1)
    turn, job = estimate_turn(track_map, CAMERA, RightTurn(NONE, KNOWN), TrackOptions())
    assert job is None
    sigma = np.degrees(np.sqrt(np.diag(turn.covariance)))
    assert sigma[1] == pytest.approx(GATES.sigma_deg, rel=1e-3) and sigma[0] < 0.01 > sigma[2]


def test_a_map_is_corrected_and_its_scene_is_that_of_a_rectified_pair():
    """Tracked as if nothing were turned: places, columns and depths are then those of the rectified pair."""
    track_map, places = _map(5, TURN, noise=0.02)
    exact = _map(5, NONE, noise=0.02)[0]
    # Landmarks where the wrong disparities put them.
    at = into(track_map.keyframes[0].pose, places)
    pixel = CAMERA.project(at)
    right = CAMERA.project((at - [CAMERA.baseline, 0, 0]) @ _exp(TURN).T)
    wrong = CAMERA.fx * CAMERA.baseline / (pixel - right)[:, 0]
    good = wrong > 0
    track_map.points.xyz[good] = (at * (wrong / at[:, 2])[:, None])[good]
    before = RightTurn(NONE, KNOWN)
    turn, job = estimate_turn(track_map, CAMERA, before, TrackOptions())
    correct_map(track_map, CAMERA, before, turn, TrackOptions(), job)
    seen = track_map.points.alive & (np.bincount(track_map.keyframes[0].measured.points.index, minlength=700) > 0)
    away = np.linalg.norm(track_map.points.xyz - places, axis=1)[seen] / places[seen, 2]
    assert np.median(away) < 0.01 < np.median(np.abs(wrong / at[:, 2] - 1.0))
    scene, wanted = map_to_scene(track_map, CAMERA), map_to_scene(exact, CAMERA)
    np.testing.assert_allclose(
        np.median(scene.right_columns.u_right[:100] - wanted.right_columns.u_right[:100]), 0.0, atol=0.05
    )


def test_jacobians_of_turned_right_cameras():
    """Of the residuals of a whole problem by its right camera, through the solver's retract: central differences."""
    scene = map_to_scene(_map(0, TURN)[0], CAMERA)
    prior = RightTurnPrior(0.5 * TURN, np.linalg.cholesky(np.linalg.inv(np.diag([1e-3, 2e-3, 3e-3]) ** 2)).T)
    problem = assemble(scene, replace(TRACKING, right_turn=prior)).problem
    group = problem.variables[RIGHT_CAMERAS]
    np.testing.assert_array_equal(np.asarray(group.constant), [[True, True, True, False, False, False]])
    factors = [f for f in problem.factors if any(ref.group == RIGHT_CAMERAS for _, ref in f.references())]
    assert [factor.type_name for factor in factors] == ["point_reprojection", "pose_prior"]
    for factor in factors:
        slots = [ref.group for _, ref in factor.references()]
        columns = tuple(0 if name == RIGHT_CAMERAS else -1 for name in slots)
        record = np.zeros((len(factor), factor.residual_size, 7))
        ambients = tuple(problem.variables[name].ambient() for name in slots)
        factor.linearize(factor.prepare(ambients), 0, len(factor), columns, record)
        for k in range(3, 6):
            both = []
            for sign in (1.0, -1.0):
                step = np.zeros((1, 6))
                step[0, k] = sign * 1e-6
                moved = group.with_state(group.manifold.retract(group.state, step))
                both.append(residuals_of(factor, {**problem.variables, RIGHT_CAMERAS: moved}))
            numeric = ((both[0] - both[1]) / 2e-6).reshape(record.shape[:2])
            np.testing.assert_allclose(record[..., k], numeric, rtol=1e-5, atol=1e-4)


# ------------------------------------------------------------------------------------------------------ whole tracks


def _turned_frames(turn, truth):
    """Frames of the room with a right camera that is turned."""
    shift = np.array([0, 0, 0, 1, -_room.BASELINE, 0, 0])
    turned = np.concatenate([quaternion.exp(turn[None])[0], np.zeros(3)])
    right = se3.compose(turned[None], shift[None])
    return [
        replace(frame, right=_room.render(se3.compose(right, pose[None])[0])[0])
        for frame, pose in zip(_room.frames("mono", truth), truth, strict=True)
    ]


def test_a_track_with_a_turned_right_camera():
    """Of 0.1, 0.2 and -0.15 degrees: the track begins anew as soon as motion tells yaw, and keeps what it found."""
    turn, truth = np.radians([0.1, 0.2, -0.15]), _room.poses(36)
    frames = _turned_frames(turn, truth)
    options = TrackOptions(num_points=250, num_features=500, lines=False)
    tracker, better, count = Tracker(_room.camera(_room.BASELINE), options), None, 0
    while better is None and count < 30:
        assert tracker.process(frames[count]).status == "tracked"
        better, count = tracker.begun_anew(), count + 1
    assert better is not None
    assert {better.process(frame).status for frame in frames} == {"tracked"} and better.begun_anew() is None
    result = better.finish()
    found = result.statistics["right_camera"]
    error = np.array(found["angles_deg"]) - np.degrees(turn)
    np.testing.assert_allclose(error[[0, 2]], 0.0, atol=0.01)
    # Two keyframes in a small room tell yaw to 0.08 pixels of 0.91.
    assert abs(error[1]) < 4.0 * found["sigma_deg"][1] < 0.1
    assert _room.position_error(result.trajectory, truth) < 0.01
    again = Tracker(_room.camera(_room.BASELINE), right_turn=RightTurn(turn, 1e-8 * np.eye(3)))
    assert again.begun_anew() is None
