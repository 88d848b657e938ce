# SPDX-License-Identifier: BSD-3-Clause
"""Which images of a map a query may show: descriptors of points, gathered by words (VLAD).

Each descriptor goes to the nearest word of a vocabulary that is made from the map itself; what is left of it there is
summed, word by word, and every sum is brought to length one, so that a repeated pattern counts once.

Reference: R. Arandjelović, A. Zisserman, *All about VLAD*, 2013, sections 2 and 3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray
from groma.features.images import to_gray
from groma.localization.features import Bytes, find_points, summed, unit

#: Words of a vocabulary, and descriptors that it is made from at most (cost: time of making and comparing).
WORDS, _SAMPLE = 32, 20_000


@dataclass(frozen=True, eq=False)
class VladRetrieval:
    """Image retrieval by aggregated descriptors; a :class:`groma.features.contract.ImageRetrieval`."""

    #: (K, 128) words.
    vocabulary: npt.NDArray[np.float32]

    def describe(self, image: npt.NDArray[np.generic]) -> npt.NDArray[np.float32]:
        """Description of an image, a vector of length one; zeros for an image without points."""
        return self.gather(find_points(to_gray(image)).descriptors)

    def gather(self, descriptors: Bytes) -> npt.NDArray[np.float32]:
        """Description (K * 128,) of an image with these descriptors of points."""
        words, total = self.vocabulary, np.zeros_like(self.vocabulary)
        if len(descriptors) and len(words):
            nearest = (unit(descriptors) @ words.T - 0.5 * (words**2).sum(axis=1)).argmax(axis=1)
            count = np.bincount(nearest, minlength=len(words)).astype(np.float32)
            total = summed(descriptors, nearest, len(words)) - count[:, None] * words
        total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), np.float32(1e-9))
        return total.ravel() / np.float32(max(np.linalg.norm(total), 1e-9))

    def similarity(self, query: Any, others: Sequence[Any]) -> FloatArray:
        """Cosine of descriptions, (N,) between -1 and 1."""
        return np.asarray(np.asarray(others, np.float32).reshape(len(others), -1) @ query, np.float64)

    @staticmethod
    def learned(descriptors: Sequence[Bytes], seed: int = 0) -> VladRetrieval:
        """Make a vocabulary from the descriptors of the images of a map."""
        every = np.concatenate([*descriptors, np.zeros((0, 128), np.uint8)])
        rows = np.random.default_rng(seed).permutation(len(every))[:_SAMPLE]
        if len(rows) < WORDS:
            return VladRetrieval(unit(every[rows]))
        cv2.setRNGSeed(seed)
        stop = (cv2.TERM_CRITERIA_MAX_ITER, 12, 0.0)
        words = cv2.kmeans(unit(every[rows]), WORDS, None, stop, 1, cv2.KMEANS_PP_CENTERS)[2]  # type: ignore[call-overload]
        return VladRetrieval(np.asarray(words, np.float32))
