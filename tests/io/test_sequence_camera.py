# SPDX-License-Identifier: BSD-3-Clause
"""The camera of a sequence: what it takes, how it is said, what it refuses, and images without its distortion."""

import cv2
import numpy as np
import pytest
from _sequences import POINTS, blob_center, blob_image

from groma import cameras
from groma.errors import InputError
from groma.io.sequences import SequenceCamera, open_sequence


def test_a_camera_takes_lists_and_keeps_an_array_of_its_own():
    params = np.array([50.0, 51.0, 32.0, 24.0])
    camera = SequenceCamera("PINHOLE", params, 64, 48)
    params[0] = 0.0
    assert camera.params[0] == 50.0
    np.testing.assert_array_equal(SequenceCamera("PINHOLE", [50, 51, 32, 24], 64, 48).params, camera.params)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("PINHOLE", [50, 51, 32], 64, 48), r"PINHOLE takes 4 finite numbers \(fx, fy, cx, cy\); got \[50.0"),
        (("PINHOLE", [50, 51, 32, 24, 0], 64, 48), "takes 4 finite numbers"),
        (("OPENCV", [50, 51, 32, 24], 64, 48), "takes 8 finite numbers"),
        (("PINHOLE", [50, np.nan, 32, 24], 64, 48), "takes 4 finite numbers"),
        (("PINHOLE", None, 64, 48), "takes 4 finite numbers"),
        (("PINHOLE", "wide", 64, 48), "could not convert"),
        (("PINHOLE", [50, -51, 32, 24], 64, 48), "focal lengths must be positive"),
        (("CIRCLE", [50, 51, 32, 24], 64, 48), "must be one of"),
        (("PINHOLE", [50, 51, 32, 24], 64, 0), "width and height must be positive"),
        (("PINHOLE", [50, 51, 32, 24], 64, 48, 0.0), "baseline must be positive"),
    ],
)
def test_a_camera_of_a_sequence_is_checked(arguments, words):
    with pytest.raises(InputError, match=words):
        SequenceCamera(*arguments)


@pytest.mark.parametrize(
    ("camera", "params"),
    [
        ("50 51 32 24", [50, 51, 32.5, 24.5]),
        ([50, 51, 32, 24], [50, 51, 32.5, 24.5]),
        ([[50, 0, 32], [0, 51, 24], [0, 0, 1]], [50, 51, 32.5, 24.5]),
        ("1 PINHOLE 64 48 50 51 32 24", [50, 51, 32, 24]),
        ("SIMPLE_PINHOLE 64 48 50 32 24", [50, 50, 32, 24]),
        (SequenceCamera("PINHOLE", np.array([50.0, 51, 32, 24]), 64, 48), [50, 51, 32, 24]),
        ("50 51 32 24 -0.2 0.05 0.001 0.002", [50, 51, 32.5, 24.5]),
    ],
)
def test_ways_to_say_a_camera(tum, tmp_path, camera, params):
    np.testing.assert_array_equal(open_sequence(tum, camera=camera).camera.params, params)
    if isinstance(camera, str):
        (tmp_path / "other.txt").write_text(f"# a comment\n{camera}\n")
        np.testing.assert_array_equal(open_sequence(tum, camera=tmp_path / "other.txt").camera.params, params)


def test_matrix_file(tum):
    (tum / "camera.txt").write_text("50 0 32\n0 51 24\n0 0 1\n")
    np.testing.assert_array_equal(open_sequence(tum).camera.params, [50, 51, 32.5, 24.5])


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        ("50 51 32", "Cannot read"),
        ([50, 51, 32], "3 numbers"),
        ("1 PINHOLE 64 48 50 51 32", "takes 4"),
        ("1 CIRCLE 64 48 50 51 32", "CIRCLE"),
        ("1 PINHOLE 640 480 500 500 320 240", "for images of"),
        ("-50 51 32 24", "positive"),
        ("missing.txt", "Cannot read"),
        ("PINHOLE 64 48 a 51 32 24", "not a camera"),
        ("PINHOLE wide 48 50 51 32 24", "not a camera"),
        ([50, [51], 32, 24], "not a camera"),
    ],
)
def test_cameras_that_are_refused(tum, camera, words):
    with pytest.raises(InputError, match=words):
        open_sequence(tum, camera=camera)


def test_undistortion_puts_points_where_a_pinhole_sees_them(tmp_path):
    size, numbers = (320, 240), np.array([250.0, 255, 158, 121, -0.25, 0.08, 0.002, -0.001])
    distorted = cameras.model("OPENCV").project(numbers + np.array([0, 0, 0.5, 0.5, 0, 0, 0, 0]), POINTS)
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images/0001.png"), blob_image(distorted, size))
    sequence = open_sequence(tmp_path, camera=numbers)
    expected = cameras.model("PINHOLE").project(sequence.camera.params, POINTS)
    assert np.abs(expected - distorted).max() > 1.2
    gray = next(iter(sequence)).gray
    for point in expected:
        np.testing.assert_allclose(blob_center(gray, point), point, atol=0.15)  # blobs are bent and rounded to 8 bits


def test_depth_is_undistorted_with_the_image(tum):
    ramp = np.tile(np.arange(1, 65, dtype=np.uint16) * 100, (48, 1))
    cv2.imwrite(str(tum / "depth/0.png"), ramp)
    cv2.imwrite(str(tum / "rgb/0.png"), (ramp // 100).astype(np.uint8))
    frame = next(iter(open_sequence(tum, camera="50 50 31.5 23.5 -0.2 0 0 0", depth_scale=100)))
    inside = frame.depth > 0
    assert inside.mean() > 0.9
    assert np.abs(frame.depth[inside] - frame.gray[inside]).max() <= 1.0
    assert (frame.depth != ramp / 100).any()
