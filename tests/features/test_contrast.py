# SPDX-License-Identifier: BSD-3-Clause
"""Covers the contrast of segments: edges, stripes of texture, borders of the image, and detectors that tell it."""

import cv2
import numpy as np
import pytest

from groma.features import LsdDetector, Segments
from groma.features.contrast import WithContrast, contrast_of
from groma.features.edge_fit import measure_edges


def rated(image, ends):
    """Segments as a detector would rate them, and their contrast."""
    ends, sigma, strength = measure_edges(image, np.asarray(ends, float), fit=False)
    return contrast_of(image, Segments(ends, sigma, strength))


def picture(levels, noise=0.0, seed=0):
    levels = levels + np.random.default_rng(seed).normal(0.0, noise, levels.shape) if noise else levels
    return np.clip(np.round(levels), 0, 255).astype(np.uint8)


def stripes(period, height=8.0):
    """Upright stripes without a noise, all alike."""
    return picture(np.tile(120.0 + height * np.sin(2 * np.pi * np.arange(200) / period), (200, 1)))


def test_a_weak_edge_between_flat_faces_stands_out():
    levels = np.full((200, 200), 120.0)
    levels[:, 100:] += 12.0
    assert rated(picture(levels), [[100, 40, 100, 160]])[0] > 50.0
    assert rated(picture(levels, noise=2.0), [[100, 40, 100, 160]])[0] > 15.0


@pytest.mark.parametrize("period", [6, 9, 14])
def test_a_stripe_among_stripes_does_not(period):
    # The steepest place of a sine is the square root of two above its median.
    found = rated(stripes(period), [[10 * period, 40, 10 * period, 160]])
    assert 0.8 < found[0] < 1.8


def test_texture_lies_below_the_gate_and_gain_does_not_matter():
    rng, detector = np.random.default_rng(1), WithContrast(LsdDetector(min_length=12.0))
    pattern = cv2.GaussianBlur(rng.normal(size=(300, 300)), (0, 0), sigmaX=2.0, sigmaY=12.0)
    dark, bright = (detector.detect(picture(120.0 + height * pattern / pattern.std())) for height in (12.0, 24.0))
    assert len(dark) > 20 and np.median(dark.contrast) < 3.0
    assert np.median(bright.contrast) == pytest.approx(np.median(dark.contrast), rel=0.2)


def test_what_lies_outside_the_image_is_not_known():
    levels = np.full((200, 200), 120.0)
    levels[:, 2:] += 30.0
    # One side of it is out of view, and of the other all is seen.
    assert rated(picture(levels), [[2, 40, 2, 160]])[0] > 50.0
    narrow = levels[:, :4]
    assert rated(picture(narrow), [[2, 40, 2, 160]])[0] == 0.0
    assert contrast_of(picture(levels), Segments.from_ends([[50, 40, 50, 160]]))[0] == 0.0
    assert len(contrast_of(picture(levels), Segments.empty())) == 0


def test_many_segments_are_as_few():
    image = picture(np.random.default_rng(2).normal(120, 30, (200, 200)))
    ends = np.random.default_rng(3).uniform(20, 180, (4500, 4))
    many = rated(image, ends)
    np.testing.assert_array_equal(many[:7], rated(image, ends[:7]))
    np.testing.assert_array_equal(many[-7:], rated(image, ends[-7:]))


def test_the_detector_is_the_one_it_holds():
    levels = np.full((200, 200), 120.0)
    levels[60:140, 60:140] = 200.0
    plain, told = (detector.detect(picture(levels)) for detector in (LsdDetector(), WithContrast(LsdDetector())))
    np.testing.assert_array_equal(told.ends, plain.ends)
    assert (plain.contrast == 0.0).all() and (told.contrast > 20.0).all()
    np.testing.assert_array_equal(told.select([1, 0]).contrast, told.contrast[[1, 0]])
    np.testing.assert_array_equal(Segments.joined([plain, told]).contrast, [*plain.contrast, *told.contrast])
