# SPDX-License-Identifier: BSD-3-Clause
"""When a single camera that begins asks for motions."""

import cv2
import numpy as np
import pytest
from _room import camera

from groma.io.sequences import Frame
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.frame.features import FrameFeatures
from groma.tracking.options import TrackOptions
from groma.tracking.pose.initialise import Initialiser

pytestmark = pytest.mark.kernels


def _painted(rng, shape: tuple[int, int]) -> np.ndarray:
    small = rng.integers(0, 256, (shape[0] // 4, shape[1] // 4)).astype(np.uint8)
    return cv2.resize(small, shape[::-1], interpolation=cv2.INTER_CUBIC)


@pytest.mark.parametrize(("lost", "asked"), [(True, [2]), (False, [])])
def test_motions_are_asked_for_when_most_points_are_gone(monkeypatch, lost, asked):
    """Far points in the middle move by a pixel, less than is waited for; those around it are out of sight or stay."""
    rng, calls = np.random.default_rng(4), []
    far, around = _painted(rng, (100, 140)), _painted(rng, (240, 320))
    options, start = TrackOptions(), None
    for number in range(3):
        image = np.full_like(around, 128) if lost and number == 2 else around.copy()
        image[70:170, 90 + number : 230 + number] = far
        data = FrameFeatures(Frame(number / 30, image), TrackCamera.of(camera()), options)
        start = start or Initialiser(data.camera, options)
        monkeypatch.setattr(start, "_propose", lambda number=number: calls.append(number))
        assert start.try_start(data) is None
    assert calls == asked
