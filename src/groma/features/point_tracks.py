# SPDX-License-Identifier: BSD-3-Clause
"""Follow points from image to image by OpenCV's pyramidal Lucas-Kanade, and find new ones worth following.

Where there is nothing but noise, Lucas-Kanade stays near its initial place, and such a point would confirm
whatever was predicted. So patches must be alike, and corners must stand out from the noise of the image.

Pixels count from the corner of the image (first pixel's centre at 0.5, 0.5).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from groma._numba import loop
from groma._typing import BoolArray, FloatArray, IntArray
from groma.features.images import GrayImage
from groma.gates import SEQUENCES, SIGMA_OF_MEDIAN, gate

_HALF = np.float32(0.5)
#: Largest difference that :func:`image_noise` counts (derived from its weights).
_LARGEST = 8 * 255


@dataclass(frozen=True)
class PointTrackGates:
    """Points worth following, and points that were followed."""

    min_alike: float = gate(0.5, "correlation", "of a patch with the one before", "derived from signal over noise")
    iterations: int = gate(15, "steps", "steps of Lucas-Kanade on each level", "cost: converges in fewer")
    converged: float = gate(0.03, "px", "a smaller step ends them", "cost: a tenth of what they are good for")
    min_texture: float = gate(1e-4, "1", "least eigenvalue of a patch, OpenCV's units", "convention: OpenCV's default")
    block: int = gate(5, "px", "width of the blocks in which corners are rated", "chosen on rendered rooms")
    above_noise: float = gate(4.0, "ratio", "eigenvalue of a corner to noise", "derived from noise: three in 640 x 480")
    quality: float = gate(0.005, "share", "eigenvalue of a corner, of the strongest", "chosen on rendered rooms")
    max_shift: float = gate(2.5, "px", "of a point from where it was expected", SEQUENCES)

    @property
    def noise_eigenvalue(self) -> float:
        """Mean eigenvalue that noise of one grey level makes: 12 times the samples, by 4, the width and 255."""
        return 12.0 * self.block**2 / (4.0 * self.block * 255.0) ** 2  # derived from Sobel's weights


#: The numbers in use.
POINT_TRACKS = PointTrackGates()


# ------------------------------------------------------------------------------------------------------------ Kernels


@loop
def _correlate_all(first, second, out):
    """Write the correlation of the rows of two tables of grey levels; sums of whole numbers are exact."""
    count = first.shape[1]
    for i in range(first.shape[0]):
        a = b = aa = bb = ab = np.int64(0)
        for k in range(count):
            x, y = np.int64(first[i, k]), np.int64(second[i, k])
            a += x
            b += y
            aa += x * x
            bb += y * y
            ab += x * y
        size = math.sqrt(float(aa * count - a * a) * float(bb * count - b * b))
        out[i] = float(ab * count - a * b) / max(size, 1e-6)


@loop
def _count_differences(image, count):
    """Count the sizes of second differences across and down, at every second pixel of every second row inside."""
    for i in range(0, image.shape[0] - 2, 2):
        above, here, below = image[i], image[i + 1], image[i + 2]
        for j in range(0, image.shape[1] - 2, 2):
            value = np.int64(4) * here[j + 1] + above[j] + above[j + 2] + below[j] + below[j + 2]
            value -= np.int64(2) * (above[j + 1] + here[j] + here[j + 2] + below[j + 1])
            count[abs(value)] += 1


# ------------------------------------------------------------------------------------------------------------- Public


def follow(
    image_1: GrayImage,
    image_2: GrayImage,
    pixels: FloatArray,
    guesses: FloatArray | None = None,
    levels: int = 3,  # convention: of OpenCV
    window: int = 15,
    round_trip: float | None = 1.0,
    max_shift: float = math.inf,
) -> tuple[FloatArray, BoolArray]:
    """Where points of the first image are in the second.

    Parameters
    ----------
    image_1, image_2 : (H, W) uint8
        Images.
    pixels : (N, 2)
        Points of the first image, pixels.
    guesses : (N, 2), optional
        Where they are expected in the second; the same place by default.
    levels : int
        Levels of the pyramid above the image itself.
    window : int
        Width of the compared patches, pixels.
    round_trip : float, optional
        Maximum forward-backward error, pixels; None: no backward pass.
    max_shift : float
        Points found this far from where they were expected are given up, before the backward pass; pixels.

    Returns
    -------
    (N, 2) float64, (N,) bool
        Pixels, and which points were found inside the image, with a patch like the one they had.
    """
    if not len(pixels):
        return np.zeros((0, 2)), np.zeros(0, dtype=bool)
    settings: dict = {
        "winSize": (window, window),
        "maxLevel": levels,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, POINT_TRACKS.iterations, POINT_TRACKS.converged),
        "minEigThreshold": POINT_TRACKS.min_texture,
    }
    start = np.ascontiguousarray(pixels, dtype=np.float32) - _HALF
    guess = start.copy() if guesses is None else np.ascontiguousarray(guesses, dtype=np.float32) - _HALF
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        image_1, image_2, start, guess.copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **settings
    )
    good = found.ravel() == 1
    height, width = image_2.shape
    with np.errstate(invalid="ignore"):
        good &= ((there >= 0) & (there <= (width - 1, height - 1))).all(axis=1)
        expected = pixels if guesses is None else guesses
        good &= np.linalg.norm(there.astype(np.float64) + 0.5 - expected, axis=1) < max_shift
    if good.any():
        rows = np.flatnonzero(good)
        good[rows] = _alike(image_1, image_2, start[rows], there[rows], window) > POINT_TRACKS.min_alike
    if round_trip is not None and good.any():
        settings["maxLevel"] = min(1, levels)
        rows = np.flatnonzero(good)
        home, returned, _ = cv2.calcOpticalFlowPyrLK(
            image_2, image_1, there[rows], start[rows].copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **settings
        )
        good[rows] = (returned.ravel() == 1) & (np.linalg.norm(home - start[rows], axis=1) <= round_trip)
    return there.astype(np.float64) + 0.5, good


def _alike(image_1: GrayImage, image_2: GrayImage, first: np.ndarray, second: np.ndarray, window: int) -> FloatArray:
    """Correlation (N,) of the patches around points (N, 2) of two images, in OpenCV's pixels."""
    reach = np.arange(window, dtype=np.float32) - window // 2
    offset = np.stack(np.meshgrid(reach, reach)).reshape(2, 1, -1)
    patches = []
    for image, places in ((image_1, first), (image_2, second)):
        at = places.T[..., None] + offset
        values = cv2.remap(image, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        patches.append(np.asarray(values, np.uint8))
    out = np.zeros(len(first))
    _correlate_all(*patches, out)
    return out


def spread(
    pixels: FloatArray, strength: FloatArray, taken: FloatArray, shape: tuple[int, int], count: int, cell: int
) -> IntArray:
    """Choose points evenly over the image: the strongest of each grid cell that holds no point yet.

    Parameters
    ----------
    pixels : (N, 2)
        Candidates, pixels.
    strength : (N,)
        Higher is better.
    taken : (M, 2)
        Points that are there already, pixels.
    shape : (H, W)
        Size of the image.
    count : int
        Most points chosen.
    cell : int
        Width of a cell, pixels.

    Returns
    -------
    (n,) int
        Rows of the candidates, strongest first.
    """
    columns = shape[1] // cell + 1
    used = np.zeros((shape[0] // cell + 1) * columns, dtype=bool)
    if len(taken):
        at = (np.clip(taken, 0, (shape[1] - 1, shape[0] - 1)) // cell).astype(np.int64)
        used[at[:, 1] * columns + at[:, 0]] = True
    order = np.argsort(-strength, kind="stable")
    at = (pixels[order] // cell).astype(np.int64)
    cells = at[:, 1] * columns + at[:, 0]
    order, cells = order[~used[cells]], cells[~used[cells]]
    return order[np.sort(np.unique(cells, return_index=True)[1])][:count]


def corners(image: GrayImage, count: int, distance: float) -> FloatArray:
    """Corners (Shi and Tomasi) that noise does not explain, (N, 2) pixels, strongest first."""
    gates = POINT_TRACKS
    everywhere: Any = None  # missing in OpenCV's types
    found, strength = cv2.goodFeaturesToTrackWithQuality(
        image, count, gates.quality, distance, everywhere, blockSize=gates.block
    )
    if found is None:
        return np.zeros((0, 2))
    at, strength = found.reshape(-1, 2), strength.ravel()
    noise = gates.noise_eigenvalue * image_noise(image) ** 2
    return at[strength > gates.above_noise * noise].astype(np.float64) + 0.5


def image_noise(image: GrayImage) -> float:
    """Standard deviation of the noise of an image, grey levels, from differences that planes of grey do not make."""
    count = np.zeros(_LARGEST + 1, np.int64)
    _count_differences(cv2.copyMakeBorder(image, 1, 1, 1, 1, cv2.BORDER_REFLECT_101), count)
    # They are whole numbers: the median is where half of them are counted.
    below = np.cumsum(count)
    middle = [(below[-1] - 1) // 2, below[-1] // 2]
    return SIGMA_OF_MEDIAN / 6.0 * float(np.searchsorted(below, middle, side="right").mean())
