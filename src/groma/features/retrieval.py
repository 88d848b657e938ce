# SPDX-License-Identifier: BSD-3-Clause
r"""Which images of a set are alike: a built-in retrieval, and ranking by any.

The built-in one describes an image by histograms of gradient orientations over a coarse grid (as GIST does, without its
filters): it tells views from about the same place and direction, and needs no vocabulary. Two descriptions of length
one are compared by their product.

Reference: A. Oliva, A. Torralba, *Modeling the shape of the scene*, 2001.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.errors import InputError
from groma.features.contract import ImageRetrieval
from groma.features.images import to_gray


@dataclass(frozen=True)
class GradientRetrieval:
    """Describes images by where they have gradients of which orientation."""

    #: Cells of the grid, per side.
    cells: int = 6
    #: Bins of orientations from 0 to 180 degrees.
    orientations: int = 8
    #: Pixels per cell and side to which the image is reduced.
    cell_size: int = 16

    def __post_init__(self) -> None:
        if min(self.cells, self.orientations, self.cell_size) < 2:
            raise InputError(f"cells, orientations and cell_size must be at least 2; got {self}.")

    def describe(self, image: npt.NDArray[np.generic]) -> FloatArray:
        """Description of an image, a vector of length one; zeros for an image without gradients."""
        side = self.cells * self.cell_size
        small = cv2.resize(to_gray(image), (side, side), interpolation=cv2.INTER_AREA).astype(np.float32)
        du, dv = cv2.Sobel(small, cv2.CV_32F, 1, 0), cv2.Sobel(small, cv2.CV_32F, 0, 1)
        angle = np.mod(np.arctan2(dv, du), np.pi) * (self.orientations / np.pi)
        bin_idx = np.minimum(angle.astype(np.int64), self.orientations - 1)
        cell = np.arange(side) // self.cell_size
        place = (cell[:, None] * self.cells + cell) * self.orientations + bin_idx
        size = self.cells * self.cells * self.orientations
        # The root keeps a few strong edges from standing for the whole image.
        histogram = np.sqrt(np.bincount(place.ravel(), np.hypot(du, dv).ravel().astype(np.float64), size))
        length = np.linalg.norm(histogram)
        return histogram / length if length > 0.0 else histogram

    def similarity(self, query: FloatArray, others: Sequence[FloatArray]) -> FloatArray:
        """Cosine of descriptions, (N,) between 0 and 1."""
        return np.asarray(others, np.float64).reshape(len(others), len(query)) @ query


def most_similar(retrieval: ImageRetrieval, query: Any, others: Sequence[Any], count: int) -> IntArray:
    """Return which of ``others`` are most like ``query``, at most ``count``, the best first.

    Parameters
    ----------
    retrieval : ImageRetrieval
        How images are compared.
    query : object
        A description by that retrieval.
    others : sequence
        Descriptions by that retrieval.
    count : int
        Maximum number.
    """
    if not len(others):
        return np.zeros(0, np.int64)
    return np.argsort(-np.asarray(retrieval.similarity(query, others)), kind="stable")[:count]
