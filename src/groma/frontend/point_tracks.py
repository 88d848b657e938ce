# SPDX-License-Identifier: BSD-3-Clause
"""Follow points from image to image by OpenCV's pyramidal Lucas-Kanade, and find new ones worth following.

Pixels count from the corner of the image (first pixel's centre at 0.5, 0.5).
"""

from __future__ import annotations

import cv2
import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.frontend.images import GrayImage

_HALF = np.float32(0.5)


def follow(
    image_1: GrayImage,
    image_2: GrayImage,
    pixels: FloatArray,
    guesses: FloatArray | None = None,
    levels: int = 3,
    window: int = 15,
    round_trip: float | None = 1.0,
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
        Points must come back to within this distance, pixels; None does not go back.

    Returns
    -------
    (N, 2) float64, (N,) bool
        Pixels, and which points were found inside the image.
    """
    if not len(pixels):
        return np.zeros((0, 2)), np.zeros(0, dtype=bool)
    settings: dict = {
        "winSize": (window, window),
        "maxLevel": levels,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 15, 0.03),
        "minEigThreshold": 1e-4,
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
    if round_trip is not None and good.any():
        settings["maxLevel"] = min(1, levels)
        rows = np.flatnonzero(good)
        home, returned, _ = cv2.calcOpticalFlowPyrLK(
            image_2, image_1, there[rows], start[rows].copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **settings
        )
        good[rows] = (returned.ravel() == 1) & (np.linalg.norm(home - start[rows], axis=1) <= round_trip)
    return there.astype(np.float64) + 0.5, good


def spread(
    pixels: FloatArray, strength: FloatArray, taken: FloatArray, shape: tuple[int, int], count: int, cell: int = 24
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
    first = np.unique(cells, return_index=True)[1]
    return order[np.sort(first)][:count]


def corners(image: GrayImage, count: int, distance: float, mask: GrayImage | None = None) -> FloatArray:
    """Corners by the smaller eigenvalue (Shi and Tomasi), (N, 2) pixels, strongest first."""
    found = cv2.goodFeaturesToTrack(image, count, 0.005, distance, mask=mask, blockSize=5)
    return np.zeros((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64) + 0.5


__all__ = ["corners", "follow", "spread"]
