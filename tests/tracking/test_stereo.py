# SPDX-License-Identifier: BSD-3-Clause
"""Disparities of a rectified pair: without a bias, up to the left border, and beside pixels that have none."""

import cv2
import numpy as np
import pytest

from groma.tracking.frame.stereo import dense_disparities, match_right

HEIGHT, WIDTH = 160, 480


def _pair(shift: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A wall seen by both cameras: the right one sees it farther left."""
    rng = np.random.default_rng(seed)
    wall = cv2.GaussianBlur(120 + 90 * rng.normal(size=(HEIGHT, WIDTH + 80)), (0, 0), 1.5)
    views = [
        cv2.warpAffine(wall, np.array([[1.0, 0, -40.0 - by], [0, 1.0, 0]]), (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC)
        for by in (0.0, shift)
    ]
    left, right = (np.clip(view + rng.normal(size=view.shape), 0, 255).astype(np.uint8) for view in views)
    return left, right


@pytest.mark.parametrize("shift", [4.0, 9.3, 20.55])
def test_dense_disparities_have_no_bias(shift):
    """Sixteenths of a pixel that are rounded up would be too large by a thirty-second on average."""
    left, right = _pair(shift)
    found = dense_disparities(left, right)
    inside = found[10:-10, 40:-20]
    assert (inside > 0).mean() > 0.5
    assert abs(inside[inside > 0].mean() - shift) < 0.02


def test_columns_near_the_left_border_are_known():
    left, right = _pair(9.0)
    strip = dense_disparities(left, right)[10:-10, 20:48]
    assert (strip > 0).mean() > 0.5
    assert abs(np.median(strip[strip > 0]) - 9.0) < 0.1


def test_a_pixel_without_a_disparity_asks_its_neighbours():
    left, right = _pair(9.0)
    pixels = np.array([[200.5, 80.5], [300.5, 60.5]])
    coarse = np.zeros(left.shape, np.float32)
    unknown = np.full(2, np.nan)
    assert np.isnan(match_right(left, right, pixels, unknown, coarse)).all()
    coarse[83, 200], coarse[66, 306] = 9.4, 8.7
    found = match_right(left, right, pixels, unknown, coarse)
    np.testing.assert_allclose(found, pixels - [9.0, 0.0], atol=0.1)
