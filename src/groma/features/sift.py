# SPDX-License-Identifier: BSD-3-Clause
"""OpenCV's SIFT in a bounded memory, in groma's pixel convention.

SIFT begins with an image of twice the size and keeps all layers of it, 235 bytes for each pixel of the original. A
large image is therefore processed in two ways. What is found at the first two octaves, in the doubled image and in the
image itself, depends on its surroundings alone: it comes from tiles that overlap by as much, and is the same as from
the whole. Larger scales come from the image at half its size, blurred as SIFT takes an image to be, and that one is
looked at in the same manner. Its own doubled image is not used: interpolation adds a blur that finer scales show.

Where OpenCV doubles an image, the middle of a pixel becomes that of the first of its two, and all places come out a
quarter of a pixel too far to the right and too low: 0.250 in either direction for rendered spots of any size. That is
taken back here and nowhere else. (``enable_precise_upscale`` does it by interpolating at other places, with an image
that is blurred more.)

References
----------
D. G. Lowe, *Distinctive image features from scale-invariant keypoints*, 2004.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from groma._rows import Rows, column
from groma._typing import FloatArray, IntArray
from groma.features.images import GrayImage

#: Maximum pixels of an image processed as a whole, and sides of the tiles of others (cost: memory and time).
AT_ONCE, TILE = 2**21, 1216
#: Pixels around a tile that what is found there depends on, and some more, derived from the method. Pixels of the
#: doubled image: 34 by the filters up to the layer from which the second octave is made; there, twice 29 by those up
#: to the last layer that is described, twice 38 by the largest descriptor and twice 5 by steps towards a peak:
#: together 178, of the image 89. (Places of a diameter of 8 pixels, for which nothing is doubled: 6 by the filter,
#: 43 by the descriptor.) A multiple of 16, as the sides, so that a pixel is computed by the same instructions as in
#: the whole image.
_AROUND, _STEP = 96, 16
#: Where OpenCV's places lie from the true ones because of the doubled image, pixels (derived from halving it).
_DOUBLED = np.array([-0.25, -0.25])
#: Diameter of places that come without one, pixels (convention: half of a patch of SIFT's finest scale).
PLACE_SIZE = 8.0
#: Blur that SIFT takes images to have, pixels (its definition).
_BLUR = 0.5


@dataclass(frozen=True, eq=False)
class Blobs(Rows):
    """Places of an image that SIFT describes."""

    #: (n, 2) pixels, (n,) diameters in pixels, contrasts, and octaves: -1 is that of the doubled image.
    pixels: FloatArray = column(2)
    size: FloatArray = column()
    response: FloatArray = column()
    octave: IntArray = column(dtype=np.int64)
    #: (n, 128) descriptors.
    descriptors: npt.NDArray[np.float32] = column(128, dtype=np.float32)


def find_blobs(image: GrayImage, most: int, contrast: float) -> Blobs:
    """Find and describe blobs of any scale and direction, a limited number of those of highest contrast."""
    sift = cv2.SIFT_create(nfeatures=most, contrastThreshold=contrast, enable_precise_upscale=False)  # type: ignore[attr-defined]
    tiles = _Tiles.of(image)
    if tiles.count == 1:
        return _moved(_blobs(*sift.detectAndCompute(image, None)), _DOUBLED)
    parts = []
    for tile in range(tiles.count):
        shown, shift = tiles.shown(image, tile)
        found = _moved(_blobs(*sift.detectAndCompute(shown, None)), shift + _DOUBLED)
        parts.append(found.take((found.octave <= 0) & (tiles.tile_of(found.pixels) == tile)))
    # Every second pixel, blurred as SIFT takes images to be.
    blurred = cv2.GaussianBlur(image, (0, 0), math.sqrt((2.0 * _BLUR) ** 2 - _BLUR**2))
    rest = find_blobs(np.ascontiguousarray(blurred[::2, ::2], np.uint8), most, contrast)
    rest = rest.take(rest.octave >= 0)
    parts.append(Blobs(2.0 * rest.pixels - 0.5, 2.0 * rest.size, rest.response, rest.octave + 1, rest.descriptors))
    found = Blobs.stack(parts)
    return found.take(np.sort(np.argsort(-found.response, kind="stable")[:most]))


def describe_upright(image: GrayImage, pixels: FloatArray) -> tuple[Blobs, IntArray]:
    """Describe given places (n, 2), upright; also return the rows of those that are not left out, at the border."""
    sift, tiles = cv2.SIFT_create(), _Tiles.of(image)  # type: ignore[attr-defined]
    tile_of, parts, rows = tiles.tile_of(pixels), [Blobs.empty()], [np.zeros(0, np.int64)]
    for tile in np.unique(tile_of).tolist():
        shown, shift = tiles.shown(image, tile)
        chosen = np.flatnonzero(tile_of == tile)
        places = [
            cv2.KeyPoint(u - 0.5, v - 0.5, PLACE_SIZE, 0.0, 1.0, 0, row)
            for row, (u, v) in zip(chosen.tolist(), (pixels[chosen] - shift).tolist(), strict=True)
        ]
        kept, described = sift.compute(shown, places)
        parts.append(_moved(_blobs(kept, described), shift))
        rows.append(np.array([one.class_id for one in kept], np.int64))
    row = np.concatenate(rows)
    order = np.argsort(row, kind="stable")
    return Blobs.stack(parts).take(order), row[order]


@dataclass(frozen=True)
class _Tiles:
    """The tiles of an image, row by row."""

    #: Rows and columns of tiles, and of the pixels of one.
    grid: tuple[int, int]
    side: tuple[int, int]

    @staticmethod
    def of(image: GrayImage) -> _Tiles:
        """Return as few tiles as memory allows, of about equal size."""
        if image.size <= AT_ONCE:
            return _Tiles((1, 1), image.shape)
        side = [_STEP * math.ceil(length / math.ceil(length / TILE) / _STEP) for length in image.shape]
        return _Tiles((math.ceil(image.shape[0] / side[0]), math.ceil(image.shape[1] / side[1])), (side[0], side[1]))

    @property
    def count(self) -> int:
        """Number of tiles."""
        return self.grid[0] * self.grid[1]

    def tile_of(self, pixels: FloatArray) -> IntArray:
        """Return the tiles (n,) that pixels (n, 2) are in; those beyond the border are in the nearest."""
        place = np.floor(pixels[:, ::-1] / self.side).astype(np.int64)
        row, column_ = np.clip(place, 0, np.array(self.grid) - 1).T
        return row * self.grid[1] + column_

    def shown(self, image: GrayImage, tile: int) -> tuple[GrayImage, FloatArray]:
        """Return a tile with its margin, and the first pixel (2,) of it."""
        row, column_ = divmod(tile, self.grid[1])
        top, left = max(row * self.side[0] - _AROUND, 0), max(column_ * self.side[1] - _AROUND, 0)
        bottom, right = (row + 1) * self.side[0] + _AROUND, (column_ + 1) * self.side[1] + _AROUND
        return np.ascontiguousarray(image[top:bottom, left:right]), np.array([left, top], np.float64)


def _moved(blobs: Blobs, shift: FloatArray) -> Blobs:
    """Blobs of a part of an image with the given first pixel."""
    return replace(blobs, pixels=blobs.pixels + shift)


def _blobs(found: Sequence[cv2.KeyPoint], described: npt.NDArray[np.float32] | None) -> Blobs:
    """What OpenCV found."""
    if described is None or not len(found):
        return Blobs.empty()
    octave = np.array([one.octave for one in found], np.int64) & 255
    return Blobs(
        np.array([one.pt for one in found], np.float64) + 0.5,
        np.array([one.size for one in found], np.float64),
        np.array([one.response for one in found], np.float64),
        np.where(octave > 127, octave - 256, octave),  # derived from a byte with a sign
        described,
    )
