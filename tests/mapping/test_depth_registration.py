# SPDX-License-Identifier: BSD-3-Clause
"""Depth maps of other pixels than those of their photographs: told with the way back, and only where they are."""

import numpy as np
import pytest
from _facade_depth import facade_depths

from groma.io.depth_maps import DepthMaps
from groma.mapping.depth.points import measure_depths
from groma.mapping.depth.registration import BESIDE, shifted_maps

WIDTH = 640.0


def depth(pixel: np.ndarray) -> np.ndarray:
    """A room of boxes: steps and slopes."""
    x, y = pixel[..., 0] / 80.0, pixel[..., 1] / 80.0
    return 3.0 + 0.3 * np.sin(2.0 * x) * np.cos(1.5 * y) + 0.5 * (np.floor(x) + np.floor(y)) % 2


def looked_up(shift, sigma: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    pixel = rng.uniform([40.0, 40.0], [600.0, 440.0], (1500, 2))
    measured = depth(pixel + BESIDE[:, None] * WIDTH + shift) * np.exp(rng.normal(0.0, sigma, 1500))
    measured[rng.random(measured.shape) < 0.2] = np.nan
    return measured, 0.4 * depth(pixel) * np.exp(rng.normal(0.0, sigma, 1500))


@pytest.mark.parametrize(
    ("shift", "words"),
    [
        ([13.0, 0.0], "13 pixels to the right"),
        ([-12.0, 0.0], "13 pixels to the left"),
        ([0.0, 14.0], "13 pixels down"),
        ([0.0, -13.0], "13 pixels up"),
    ],
)
def test_the_way_back_is_told(shift, words):
    """Depths that are found at a pixel belong ``shift`` beside it; looked up are 3.2, 6.4, 12.8 and 25.6 pixels."""
    (said,) = shifted_maps(*looked_up(np.array(shift), 0.01), WIDTH)
    assert f"shifted by about {words}" in said


@pytest.mark.parametrize("sigma", [0.0, 0.01, 0.05])
@pytest.mark.parametrize("shift", [[0.0, 0.0], [3.0, 0.0]])
def test_where_maps_fit_nothing_is_said(shift, sigma):
    """A shift of three pixels is within what depth cameras are off."""
    assert not shifted_maps(*looked_up(np.array(shift), sigma), WIDTH)


def test_where_maps_hold_nothing_beside_nothing_is_said():
    measured, predicted = looked_up(np.zeros(2), 0.01)
    assert not shifted_maps(np.where(np.arange(len(BESIDE))[:, None] == 0, measured, np.nan), predicted, WIDTH)
    assert not shifted_maps(measured, -predicted, WIDTH)


def test_it_is_said_of_the_maps_of_photographs(corner, tmp_path):
    scene = corner[1]
    for name, columns in (("right", 0), ("shifted", 14)):
        (tmp_path / name).mkdir()
        for stem, values in facade_depths(scene).items():
            np.save(tmp_path / name / f"{stem}.npy", np.roll(values, columns, axis=1).astype(np.float32))
    assert not any("shifted" in text for text in measure_depths(scene, DepthMaps(tmp_path / "right")).warnings)
    said = measure_depths(scene, DepthMaps(tmp_path / "shifted")).warnings
    assert any("to the left" in text for text in said)
