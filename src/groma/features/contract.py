# SPDX-License-Identifier: BSD-3-Clause
"""The contract of segment detectors. Anything with this method can take the place of :class:`LsdDetector`."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from groma.features.segments import Segments


@runtime_checkable
class SegmentDetector(Protocol):
    """Finds line segments in an image."""

    def detect(self, image: npt.NDArray[np.generic]) -> Segments:
        """Segments of an image (H, W) or (H, W, 3), 8 bit.

        Pixels count from the corner of the image (first pixel's centre at 0.5, 0.5), the darker side lies to the left
        of each segment, and ``sigma`` is the standard deviation of the end points across the segment. An image
        without edges gives no segments; nothing is raised.
        """
        ...


__all__ = ["SegmentDetector"]
