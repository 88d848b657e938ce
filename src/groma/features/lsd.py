# SPDX-License-Identifier: BSD-3-Clause
"""Segments by OpenCV's LSD, in groma's pixel convention, with a standard deviation each.

LSD works on an image reduced by ``scale`` and multiplies its coordinates by 1 / scale at the end. Its origin is the
centre of the first *reduced* pixel, which lies at 0.5 / scale from the corner of the image. Hence the shift by
0.5 / scale (0.625 pixels for 0.8) and not by 0.5; it is applied here and nowhere else.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from groma.errors import InputError
from groma.features.edge_fit import measure_smoothed
from groma.features.images import MIN_SIDE, smoothed, to_gray
from groma.features.merging import MERGES, merge_collinear
from groma.features.segments import MIN_LENGTH, MIN_STRENGTH, Segments


@dataclass(frozen=True)
class LsdDetector:
    """Line segment detector (Grompone von Gioi et al., 2010), then fitted to the grey levels."""

    #: Shortest segment, pixels.
    min_length: float = MIN_LENGTH
    #: Smallest mean gradient across a segment, grey levels (of 255) per pixel.
    min_strength: float = MIN_STRENGTH
    #: Reduction of the image before detection (convention: LSD's own).
    scale: float = 0.8
    #: Fit the end points to the grey levels across the segment (see :mod:`groma.features.edge_fit`).
    fit: bool = True
    #: Join collinear neighbours (see :mod:`groma.features.merging`).
    merge: bool = True
    #: Maximum number of segments, the longest; 0: all.
    max_segments: int = 0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.min_length) and self.min_length > 0.0):
            raise InputError(f"min_length must be positive, in pixels; got {self.min_length}. The default is 20.")
        if not 0.1 <= self.scale <= 4.0:
            raise InputError(f"scale must lie between 0.1 and 4; got {self.scale}. The default is 0.8.")
        if not (np.isfinite(self.min_strength) and self.min_strength >= 0.0):
            raise InputError(f"min_strength must be 0 or more; got {self.min_strength}. The default is 3.")
        if self.max_segments < 0:
            raise InputError(f"max_segments must be 0 (no limit) or more; got {self.max_segments}.")

    def detect(self, image: npt.NDArray[np.generic]) -> Segments:
        """Segments of an image, longest first.

        Parameters
        ----------
        image : (H, W) or (H, W, 3) uint8
            See :func:`groma.features.images.to_gray` for other types.

        Returns
        -------
        Segments
            None for images without edges or smaller than 8 x 8.
        """
        gray = to_gray(image)
        if min(gray.shape) < MIN_SIDE or gray.min() == gray.max():
            return Segments.empty()
        detected = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, self.scale).detect(gray)[0]
        if detected is None or np.size(detected) == 0:
            return Segments.empty()
        ends = np.asarray(detected, dtype=np.float64).reshape(-1, 4) + 0.5 / self.scale
        shortest = min(self.min_length, MERGES.min_piece) if self.merge else self.min_length
        ends = ends[np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1]) >= shortest]
        smooth = smoothed(gray)
        ends, sigma, strength = measure_smoothed(smooth, ends, fit=self.fit)
        if self.merge:
            merged = merge_collinear(ends)
            if len(merged) < len(ends):
                ends, sigma, strength = measure_smoothed(smooth, merged, fit=self.fit)
        found = Segments.ranked(ends, sigma, strength, gray.shape, self.min_length, self.min_strength)
        return found.select(np.arange(len(found))[: self.max_segments or len(found)])
