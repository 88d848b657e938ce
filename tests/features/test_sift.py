# SPDX-License-Identifier: BSD-3-Clause
"""SIFT in tiles is SIFT, and places are where they are."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from groma.features import sift

#: Pixels by which a peak of a rendered spot is off through the noise of grey levels (derived: eight-bit rounding moves
#: the centre of the smallest spot by some thousandths; the mean of 40 by less).
TOLERANCE = 0.02


@pytest.fixture(scope="module")
def texture() -> np.ndarray:
    """An image with structure at all scales, of sides that no tile divides."""
    rng = np.random.default_rng(5)
    image = np.zeros((701, 913))
    for step in (1, 2, 4, 8, 16, 32, 64):
        noise = rng.standard_normal((701 // step + 2, 913 // step + 2)).astype(np.float32)
        image += 12.0 * cv2.resize(noise, (913, 701), interpolation=cv2.INTER_CUBIC)
    return np.clip(image + 128.0, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def whole(texture) -> sift.Blobs:
    """What is found in the image as it is."""
    return sift.find_blobs(texture, 10**6, 0.02)


@pytest.fixture(scope="module")
def in_tiles(texture) -> sift.Blobs:
    """What is found where the image is too large to be searched at once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sift, "AT_ONCE", texture.size // 3)
        return sift.find_blobs(texture, 10**6, 0.02)


@pytest.mark.parametrize("blur", [1.5, 3.0, 6.0])
def test_spots_are_found_where_they_are(blur):
    rng = np.random.default_rng(1)
    off = []
    v, u = np.mgrid[:160, :160] + 0.5
    for center in 70.0 + 20.0 * rng.random((40, 2)):
        spot = np.exp(-0.5 * ((u - center[0]) ** 2 + (v - center[1]) ** 2) / blur**2)
        found = sift.find_blobs(np.round(60.0 + 150.0 * spot).astype(np.uint8), 10, 0.02)
        off.append(found.pixels[np.argmax(found.response)] - center)
    np.testing.assert_allclose(np.mean(off, axis=0), 0.0, atol=TOLERANCE)


def test_tiles_find_at_the_two_finest_octaves_what_the_whole_image_shows(texture, whole, monkeypatch):
    monkeypatch.setattr(sift, "AT_ONCE", texture.size // 3)
    monkeypatch.setattr(sift, "TILE", 256)
    tiled = sift.find_blobs(texture, 10**6, 0.02)
    for octave in (-1, 0):
        # Descriptors lie on whole pixels; where a place is between two, its rounding decides.
        one, other = (_sorted(found.take((found.octave == octave) & ~_between(found))) for found in (whole, tiled))
        assert len(one) > 200
        # Places are told in single precision, from the corner of the tile.
        np.testing.assert_allclose(other.pixels, one.pixels, atol=1e-3)
        for name in ("size", "response", "descriptors"):
            np.testing.assert_array_equal(getattr(other, name), getattr(one, name))


def test_the_larger_scales_of_tiled_images_are_about_those_of_the_whole(whole, in_tiles):
    coarse, found = (blobs.take(blobs.octave >= 1) for blobs in (whole, in_tiles))
    assert len(coarse) > 50
    distance = np.linalg.norm(coarse.pixels[:, None] - found.pixels, axis=2)
    # A tenth of the blur (a quarter of the diameter) is half of the noise that such points are given.
    near = distance.min(axis=1) < 0.1 * 0.5 * coarse.size
    assert near.mean() > 0.9
    assert np.median(np.abs(np.log(found.size[distance.argmin(axis=1)] / coarse.size))[near]) < 0.02


def test_the_strongest_are_kept(texture, in_tiles, monkeypatch):
    monkeypatch.setattr(sift, "AT_ONCE", texture.size // 3)
    some = sift.find_blobs(texture, 100, 0.02)
    assert len(some) == 100
    np.testing.assert_array_equal(np.sort(some.response), np.sort(in_tiles.response)[-100:])


def test_places_are_described_in_tiles_as_in_the_whole_image(texture, monkeypatch):
    rng = np.random.default_rng(2)
    pixels = rng.random((300, 2)) * texture.shape[::-1]
    whole, rows = sift.describe_upright(texture, pixels)
    assert len(rows) > 250
    monkeypatch.setattr(sift, "AT_ONCE", 1)
    monkeypatch.setattr(sift, "TILE", 256)
    tiled, again = sift.describe_upright(texture, pixels)
    np.testing.assert_array_equal(again, rows)
    np.testing.assert_array_equal(tiled.descriptors, whole.descriptors)
    np.testing.assert_allclose(tiled.pixels, pixels[rows], atol=1e-3)


def _sorted(blobs: sift.Blobs) -> sift.Blobs:
    """In an order that does not depend on tiles."""
    return blobs.take(np.lexsort((blobs.descriptors.sum(axis=1), blobs.size, blobs.response)))


def _between(blobs: sift.Blobs) -> np.ndarray:
    """Which places lie between two pixels, of the doubled image where they were found there."""
    place = (blobs.pixels - 0.25) * np.where(blobs.octave == -1, 2.0, 1.0)[:, None]
    return np.asarray((np.abs(place % 1.0 - 0.5) < 2e-3).any(axis=1))
