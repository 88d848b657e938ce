# SPDX-License-Identifier: BSD-3-Clause
"""Points that are followed: real ones to a fraction of a pixel, and none where there is only noise."""

import cv2
import numpy as np
import pytest

from groma.features.point_tracks import _alike, corners, follow, image_noise

pytestmark = pytest.mark.kernels


def _texture(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return cv2.GaussianBlur(120 + 60 * rng.normal(size=(240, 320)), (0, 0), 2.0)


def _noisy(image: np.ndarray, sigma: float, seed: int) -> np.ndarray:
    return np.clip(image + sigma * np.random.default_rng(seed).normal(size=image.shape), 0, 255).astype(np.uint8)


def test_texture_is_followed():
    image = _texture(0)
    moved = cv2.warpAffine(image, np.array([[1, 0, 3.4], [0, 1, -2.2]]), (320, 240), borderMode=cv2.BORDER_REFLECT)
    one, two = _noisy(image, 2.0, 1), _noisy(moved, 2.0, 2)
    pixels = corners(one, 200, 10)
    inside = ((pixels > 20) & (pixels < (300, 220))).all(axis=1)
    there, good = follow(one, two, pixels[inside])
    assert good.mean() > 0.9
    error = np.linalg.norm(there[good] - pixels[inside][good] - (3.4, -2.2), axis=1)
    assert np.median(error) < 0.1
    assert np.quantile(error, 0.95) < 0.5


def test_points_far_from_where_they_are_expected_are_given_up():
    image = _noisy(_texture(0), 2.0, 1)
    pixels = corners(image, 50, 10)
    pixels = pixels[((pixels > 20) & (pixels < (300, 220))).all(axis=1)]
    guess = pixels + np.where(np.arange(len(pixels)) % 2, 5.0, 1.0)[:, None]
    there, good = follow(image, image, pixels, guess)
    bounded, near = follow(image, image, pixels, guess, max_shift=4.0)
    assert good.mean() > 0.9
    np.testing.assert_array_equal(bounded, there)
    np.testing.assert_array_equal(near, good & (np.arange(len(pixels)) % 2 == 0))
    assert not follow(image, image, pixels, max_shift=0.0)[1].any()


@pytest.mark.parametrize("sigma", [1.0, 2.0, 4.0])
def test_noise_is_not_followed(sigma):
    """On a plain wall every point would stay where it was expected, and confirm it."""
    wall = np.tile(np.linspace(118, 122, 320), (240, 1))
    one, two = _noisy(wall, sigma, 3), _noisy(wall, sigma, 4)
    assert abs(image_noise(one) / sigma - 1) < 0.15
    assert len(corners(one, 200, 10)) <= 2
    pixels = np.random.default_rng(5).uniform(20, 220, (200, 2))
    _, good = follow(one, two, pixels)
    assert good.mean() < 0.02


def test_no_image_content_at_all():
    plain = np.full((120, 160), 90, np.uint8)
    assert corners(plain, 50, 8).shape == (0, 2)
    there, good = follow(plain, plain, np.array([[40.0, 40.0]]))
    assert there.shape == (1, 2)
    assert not good.any()


def test_patches_are_compared_by_their_correlation():
    rng = np.random.default_rng(6)
    one, two = _noisy(_texture(7), 2.0, 8), _noisy(_texture(7), 2.0, 9)
    at = rng.integers(20, 200, (40, 2)).astype(np.float32)
    to = at + rng.integers(-3, 4, at.shape).astype(np.float32)
    rows = np.arange(-7, 8)
    expected = []
    for (u, v), (x, y) in zip(at.astype(int), to.astype(int), strict=True):
        patches = one[v + rows[:, None], u + rows], two[y + rows[:, None], x + rows]
        expected.append(np.corrcoef(*(patch.ravel() for patch in patches))[0, 1])
    np.testing.assert_allclose(_alike(one, two, at, to, 15), expected, atol=1e-9)
    plain = np.full_like(one, 90)
    assert not _alike(plain, plain, at, to, 15).any()


@pytest.mark.parametrize("shape", [(60, 80), (61, 83), (3, 3)])
def test_noise_is_the_median_of_what_planes_of_grey_do_not_make(shape):
    image = np.random.default_rng(3).integers(0, 256, shape, dtype=np.uint8)
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    wanted = 1.4826 / 6.0 * np.median(np.abs(cv2.filter2D(image, cv2.CV_32F, kernel)[::2, ::2]))
    assert image_noise(image) == pytest.approx(wanted, rel=1e-6)
