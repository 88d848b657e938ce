# SPDX-License-Identifier: BSD-3-Clause
r"""How much a segment stands out from what lies beside it: edges are steep where all around is flat, texture is not.

A stripe of texture is one of many of its kind. Beside it the grey level rises and falls as steeply as across it, while
on both sides of an edge, however low its contrast, there are faces. With the grey level p(r) at the distance r across
the segment, averaged along it, and the mean gradient s of the segment the contrast is

.. math:: \frac{s}{\operatorname{median}\,|p(r + 1) - p(r)|}, \qquad 3 \le |r| < 12\ \text{px},

which has no unit: exposure and gain of an image do not change it. A median, since faces may hold a few further edges.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray
from groma.features.contract import SegmentDetector
from groma.features.edge_fit import REACH
from groma.features.images import GrayImage, smoothed, to_gray
from groma.features.segments import Segments
from groma.gates import gate


@dataclass(frozen=True)
class ContrastGates:
    """What lies beside a segment, and when it is flat."""

    reach: int = gate(
        12, "px", "to either side", "chosen on one room, stairs, and the pavilion: with 8 to 24 the order is as good"
    )
    flat: float = gate(0.05, "grey levels per px", "gradient of nothing", "derived from levels that are whole numbers")


GATES = ContrastGates()
#: Places along a segment at which the grey levels beside it are taken (cost: time), and segments at a time (memory).
_PLACES, _BATCH = ((np.arange(32) + 0.5) / 32).astype(np.float32), 2000


@dataclass(frozen=True)
class WithContrast:
    """A detector whose segments know how much they stand out from what lies beside them."""

    #: What finds the segments.
    detector: SegmentDetector

    def detect(self, image: npt.NDArray[np.generic]) -> Segments:
        """Segments of an image, as the detector orders them."""
        gray = to_gray(image)
        found = self.detector.detect(gray)
        return replace(found, contrast=contrast_of(gray, found))


def contrast_of(image: GrayImage, segments: Segments) -> FloatArray:
    """Return the gradient of each segment over that of the image beside it, (N,); 0 where it is not known.

    It is not known of segments without a gradient, or whose neighbourhood lies outside the image.
    """
    parts = np.array_split(np.arange(len(segments)), len(segments) // _BATCH + 1)
    smooth = smoothed(image) if len(segments) else np.zeros((0, 0), np.float32)
    beside = np.concatenate([_gradient_beside(smooth, segments.select(rows)) for rows in parts])
    return np.nan_to_num(segments.strength / np.maximum(beside, GATES.flat))


def _gradient_beside(smooth: npt.NDArray[np.float32], segments: Segments) -> FloatArray:
    """(N,) median gradient beside segments, in a smoothed image; NaN where there is none."""
    if len(segments) == 0:
        return np.zeros(0)
    steps = np.arange(REACH, GATES.reach + 1)
    first, last, along = segments.ends[:, None, :2], segments.ends[:, None, 2:], segments.direction
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)[:, None]
    shift = np.concatenate([-steps[::-1], steps])[:, None] * across  # (N, 2 K, 2)
    size = np.array(smooth.shape[::-1])
    inside = [((ends + shift >= 0.0) & (ends + shift <= size)).all(axis=2) for ends in (first, last)]
    start, way = (first + shift - 0.5).astype(np.float32), (last - first).astype(np.float32)
    x, y = ((start[..., k, None] + _PLACES * way[..., k, None]).reshape(len(segments), -1) for k in (0, 1))
    levels = cv2.remap(smooth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    profile = levels.reshape(len(segments), 2 * len(steps), -1).mean(axis=2, dtype=np.float64)
    profile[~(inside[0] & inside[1])] = np.nan
    rises = np.abs(np.diff(profile, axis=1))
    rises[:, len(steps) - 1] = np.nan  # across the segment itself
    return np.ma.median(np.ma.masked_invalid(rises), axis=1).filled(np.nan)
