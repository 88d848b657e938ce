# SPDX-License-Identifier: BSD-3-Clause
"""Least-squares matching of patches: exact places on a texture given by a formula, honest covariances, refusals."""

import numpy as np
import pytest

from groma.errors import ShapeError
from groma.features.images import smoothed
from groma.features.patch_alignment import RADIUS, align_templates, cut_templates

SHAPE = np.array([[1.08, 0.12], [-0.10, 0.95]])
SHIFT = np.array([3.37, -2.81])


def texture(places, seed=0):
    """Grey levels at places (..., 2): waves of 5 to 25 pixels in all directions."""
    rng = np.random.default_rng(seed)
    frequency, heading, phase = 2 * np.pi / rng.uniform(5.0, 25.0, 40), *rng.uniform(0.0, 2 * np.pi, (2, 40))
    waves = np.stack([frequency * np.cos(heading), frequency * np.sin(heading)])
    return 127.0 + 10.0 * np.cos(places @ waves + phase).sum(axis=-1)


def pixel_centers(width, height):
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)


def pair(size=160, noise=0.0, gain=0.8, offset=20.0, seed=0):
    """Two images; what is at x in the first is at SHAPE x + SHIFT in the second."""
    rng = np.random.default_rng(100 + seed)
    places = pixel_centers(size, size)
    first = texture(places, seed)
    second = gain * texture((places - SHIFT) @ np.linalg.inv(SHAPE).T, seed) + offset
    return [
        np.clip(np.round(image + rng.normal(0.0, noise, image.shape)), 0, 255).astype(np.uint8)
        for image in (first, second)
    ]


def aligned(images, keypoints, start_error, shape=SHAPE):
    first, second = images
    truth = keypoints @ SHAPE.T + SHIFT
    templates = cut_templates(smoothed(first), keypoints)
    count = len(keypoints)
    found = align_templates(
        smoothed(second), templates, np.arange(count), truth + start_error, np.tile(shape, (count, 1, 1))
    )
    return found, truth


@pytest.mark.kernels
def test_place_is_found_under_affine_map_gain_and_offset():
    """Without noise but rounding to grey levels the place is right to two hundredths of a pixel."""
    keypoints = np.array([[60.3, 71.9], [80.0, 64.5], [95.7, 90.2]])
    found, truth = aligned(pair(), keypoints, np.array([0.6, -0.5]), np.eye(2))
    assert found.found.all()
    assert np.linalg.norm(found.pixels - truth, axis=1).max() < 0.02
    assert found.correlation.min() > 0.995


def test_covariance_agrees_with_the_errors_made():
    rng = np.random.default_rng(5)
    whitened = []
    for seed in range(4):
        keypoints = rng.uniform(45.0, 105.0, (60, 2))
        found, truth = aligned(pair(noise=4.0, seed=seed), keypoints, rng.normal(0.0, 0.3, (60, 2)))
        error = (found.pixels - truth)[found.found]
        assert found.found.mean() > 0.95
        whitened.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance[found.found]), error))
    # The median of a chi-square of two degrees is 1.386. Smoothing correlates the noise of neighbouring pixels, which
    # the formula leaves out: standard deviations are right to within a half.
    assert 0.6 < np.sqrt(np.median(np.concatenate(whitened)) / 1.386) < 1.6


def test_nothing_is_found_without_texture_or_outside():
    first, second = pair()
    flat = np.full_like(first, 90)
    inner, corner = np.array([[80.0, 80.0]]), np.array([[RADIUS + 0.5, 80.0]])
    assert not aligned((flat, second), inner, 0.0)[0].found.any()
    assert not aligned((first, flat), inner, 0.0)[0].found.any()
    found, truth = aligned((first, second), corner, 0.0)
    assert not found.found.any()
    np.testing.assert_array_equal(found.pixels, truth)


def test_another_texture_does_not_correlate():
    found, _ = aligned((pair()[0], pair(seed=9)[1]), np.array([[70.0, 70.0], [90.0, 80.0]]), 0.0)
    assert not (found.correlation > 0.8).any()


def test_wrong_shapes_are_refused():
    image = smoothed(pair()[0])
    with pytest.raises(ShapeError, match=r"pixels must have shape \(N, 2\)"):
        cut_templates(image, np.zeros((3, 3)))
    templates = cut_templates(image, np.full((2, 2), 50.0))
    with pytest.raises(ShapeError, match="equally long"):
        align_templates(image, templates, np.arange(2), np.zeros((1, 2)), np.zeros((1, 2, 2)))
