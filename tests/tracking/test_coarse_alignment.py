# SPDX-License-Identifier: BSD-3-Clause
"""Turns between two frames from small images: exact warps, blur, and when a prediction is left alone."""

import _room
import cv2
import numpy as np
import pytest

from groma.geometry import quaternion, se3, so3
from groma.tracking.frame.camera import TrackCamera, into
from groma.tracking.frame.coarse_alignment import small_image, turn_between, turned_prediction

CAMERA = TrackCamera.of(_room.camera())


def _turned(gray: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    K = CAMERA.matrix_opencv
    homography = K @ rotation @ np.linalg.inv(K)
    return np.asarray(cv2.warpPerspective(gray, homography, gray.shape[::-1], borderMode=cv2.BORDER_REFLECT), np.uint8)


@pytest.fixture(scope="module")
def frame():
    return _room.render(_room.poses(1)[0])


@pytest.mark.parametrize("blur", [0, 9])
@pytest.mark.parametrize("omega", [(0, 0.02, 0), (0.03, -0.1, 0.02), (-0.08, 0.1, -0.05), (0, 0.17, 0)])
def test_turns_are_found(frame, omega, blur):
    gray = frame[0]
    rotation = so3.exp(np.array([omega], float))[0]
    now = _turned(gray, rotation)
    if blur:
        now = np.asarray(cv2.blur(now, (blur, 1)), np.uint8)
    found = turn_between(CAMERA, small_image(gray), small_image(now), [np.eye(3)])
    # A pixel of the small image spans 1.1 degrees.
    assert np.linalg.norm(so3.log((found @ rotation.T)[None])) < np.radians(0.5 if blur else 0.3)


def test_a_prediction_gives_way_only_to_what_the_image_shows(frame):
    gray, depth = frame
    pose = se3.identity()
    rows, columns = np.mgrid[30:210:20, 40:280:20].reshape(2, -1)
    pixels = np.column_stack([columns, rows]) + 0.5
    places = CAMERA.bearings(pixels) * depth[rows, columns][:, None]
    turn = np.concatenate([quaternion.exp(np.array([[0.02, 0.12, 0.0]]))[0], np.zeros(3)])
    now = _turned(gray, so3.exp(np.array([[0.02, 0.12, 0.0]]))[0])
    nothing, small = (np.zeros((0, 2)), np.zeros((0, 3))), (small_image(gray), small_image(now))
    found = turned_prediction(CAMERA, *small, (pixels, places), lambda: nothing, pose, pose)
    assert found is not None
    assert np.abs(CAMERA.project(into(found, places)) - CAMERA.project(into(turn, places))).max() < 4.0
    assert turned_prediction(CAMERA, *small, (pixels, places), lambda: nothing, pose, turn) is None
    few = pixels[:5], places[:5]
    assert turned_prediction(CAMERA, *small, few, lambda: nothing, pose, pose) is None
    # With few points to follow, places all over the image tell.
    found = turned_prediction(CAMERA, *small, few, lambda: (pixels, places), pose, pose)
    assert found is not None
    assert np.abs(CAMERA.project(into(found, places)) - CAMERA.project(into(turn, places))).max() < 4.0


def test_turns_are_told_though_most_points_leave_the_image(frame):
    gray, depth = frame
    rows, columns = np.mgrid[30:210:20, 20:150:10].reshape(2, -1)
    pixels = np.column_stack([columns, rows]) + 0.5
    places = CAMERA.bearings(pixels) * depth[rows, columns][:, None]
    turn = so3.exp(np.array([[0.0, -0.35, 0.0]]))[0]
    now = _turned(gray, turn)
    everywhere = np.mgrid[10:230:20, 10:310:20].reshape(2, -1)[::-1].T
    spread = everywhere + 0.5, CAMERA.bearings(everywhere + 0.5) * depth[everywhere[:, 1], everywhere[:, 0]][:, None]
    small = small_image(gray), small_image(now)
    found = turned_prediction(CAMERA, *small, (pixels, places), lambda: spread, se3.identity(), se3.identity())
    assert found is not None
    assert np.linalg.norm(so3.log((quaternion.to_matrix(found[:4]) @ turn.T)[None])) < np.radians(1.5)
