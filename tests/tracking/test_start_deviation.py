# SPDX-License-Identifier: BSD-3-Clause
"""How well the views that a single camera starts with tell its motion: against simulated errors, alike or not."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_two_views import CAMERA, GATES, IDENTITY, SECOND, SIGMA, THIRD, begun, box, judged, pose, seen

from groma.gates import NORMAL
from groma.tracking.options import TrackOptions
from groma.tracking.pose import initialise
from groma.tracking.pose.start_deviation import start_deviation
from groma.tracking.pose.two_views import Candidate, adjusted

pytestmark = pytest.mark.kernels
VIEWS = np.stack([IDENTITY, SECOND, THIRD])


def fitted(pixels, places):
    return adjusted(CAMERA, Candidate(VIEWS, places), pixels, SIGMA, NORMAL.coordinate)


@pytest.mark.parametrize("away", [0.0, 4.0])
def test_the_last_step_errs_by_what_is_stated(away):
    """Near the points tell turn from shift, far away hardly. The mean square of twelve draws scatters by 40 %."""
    ratios = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        places = box(rng, 300) + np.array([0.0, 0.0, away])
        pixels = seen(places, VIEWS, rng)
        found, true = fitted(pixels, places), THIRD[4:] / np.median(places[:, 2])
        error = np.linalg.norm(found.poses[2, 4:] - true) / np.linalg.norm(true)
        ratios.append(error / start_deviation(CAMERA, found, pixels, SIGMA))
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.6


def test_points_that_err_alike_in_a_part_of_the_image_tell_less():
    """A pixel of all in a fifth of the image, beside a stated noise of half a pixel of each."""
    stated = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        places = box(rng, 400) + np.array([0.0, 0.0, 1.0])
        pixels = seen(places, VIEWS, rng, sigma=0.05)
        fifth = (pixels[0] / (CAMERA.width / 5)).astype(int)
        alike = pixels.copy()
        alike[1:] += rng.normal(0.0, 1.0, (2, 5, 5, 2))[:, fifth[:, 1], fifth[:, 0]]
        stated.append([start_deviation(CAMERA, fitted(one, places), one, SIGMA) for one in (pixels, alike)])
    alone, together = np.mean(stated, axis=0)
    assert together > 2.0 * alone


def test_a_camera_that_turns_knows_nothing():
    rng = np.random.default_rng(2)
    turned = [IDENTITY, pose([0.0, 0.08, 0.0], [0.0, 0.0, 0.0]), pose([0.0, 0.16, 0.0], [0.0, 0.0, 0.0])]
    pixels = seen(box(rng), turned, rng)
    for candidate in judged(begun(pixels), pixels):
        assert start_deviation(CAMERA, candidate, pixels, SIGMA) > GATES.depth_sigma


def test_points_of_one_cell_tell_nothing():
    rng = np.random.default_rng(3)
    places = rng.uniform([0.01, 0.01, 2.0], [0.05, 0.05, 2.1], (80, 3))
    pixels = seen(places, VIEWS, rng)
    assert start_deviation(CAMERA, fitted(pixels, places), pixels, SIGMA) == 1.0


@pytest.mark.parametrize(("deviation", "known"), [(0.14, True), (0.16, False)])
def test_a_map_waits_until_motion_and_depths_are_known(monkeypatch, deviation, known):
    monkeypatch.setattr(initialise, "start_deviation", lambda *_: deviation)
    start: Any = initialise.Initialiser(CAMERA, TrackOptions())
    left: Any = [SimpleNamespace(agrees=np.ones(100, bool))]
    assert start._is_known(left) == known
    assert not start._is_known([*left, *left])
    assert not start._is_known([SimpleNamespace(agrees=np.arange(100) < 59)])
