# SPDX-License-Identifier: BSD-3-Clause
"""The line segments of one image.

Pixels count from the corner of the image: the first pixel's centre is (0.5, 0.5). A segment is directed from its first
to its second end point so that the **darker side lies to its left** as seen in the image (v pointing down): a person
walking along it has the dark on the left hand. The same physical edge is therefore directed alike in all images, and
the two edges of a dark bar on a bright wall are distinct.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError, ShapeError
from groma.gates import LINE_MAPS, gate
from groma.geometry import segment2

#: Defaults of detected segments: shortest length, pixels, and smallest mean gradient across,
#: grey levels (of 255) per pixel.
MIN_LENGTH, MIN_STRENGTH = 20.0, 3.0


@dataclass(frozen=True)
class SegmentGates:
    """What is one edge, and what lies on it."""

    edge: float = gate(1.0, "px", "from each other, within which segments are one edge", "derived from a sharp lens")
    on: float = gate(2.0, "px", "from a segment, within which a place or another segment is on it", LINE_MAPS)
    angle: float = gate(0.1, "rad", "between a segment and the image of its line", "derived from short segments")
    collinear: float = gate(0.02, "rad", "between pieces of one edge", "derived from a pixel at the ends of a segment")
    overlap: float = gate(0.3, "share", "of the shorter of two segments, that the other covers", LINE_MAPS)


#: The numbers in use.
SEGMENTS = SegmentGates()


@dataclass(frozen=True)
class Segments:
    """Line segments of one image, in the order the detector gives them: longest first."""

    #: (N, 4) end points u1 v1 u2 v2, pixels; darker side to the left.
    ends: FloatArray

    #: (N,) standard deviation of each end point across the segment, pixels.
    sigma: FloatArray

    #: (N,) mean gradient across the segment, grey levels (of 255) per pixel.
    strength: FloatArray

    #: (N,) that gradient over the one beside it (:mod:`groma.features.contrast`); 0, the default, where unknown.
    contrast: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        ends = np.asarray(self.ends, dtype=np.float64)
        if ends.ndim != 2 or ends.shape[1] != 4:
            raise ShapeError(f"ends must have shape (N, 4): u1 v1 u2 v2; got {ends.shape}. Reshape it to (-1, 4).")
        object.__setattr__(self, "ends", ends)
        if not len(self.contrast):
            object.__setattr__(self, "contrast", np.zeros(len(ends)))
        for name in ("sigma", "strength", "contrast"):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            if values.shape != (len(ends),):
                raise ShapeError(f"{name} must have shape ({len(ends)},), one value a segment; got {values.shape}.")
            object.__setattr__(self, name, values)
        if not (np.isfinite(ends).all() and np.isfinite([self.strength, self.contrast]).all()):
            raise InputError("Segments must be finite; got NaN or infinity. Select the finite rows first.")
        if not (np.isfinite(self.sigma).all() and (self.sigma > 0.0).all()):
            raise InputError("sigma must be positive and finite, in pixels. Pass 0.3 where nothing is known.")

    def __len__(self) -> int:
        return len(self.ends)

    @property
    def length(self) -> FloatArray:
        """(N,) lengths in pixels."""
        return segment2.length(self.ends)

    @property
    def midpoint(self) -> FloatArray:
        """(N, 2) midpoints in pixels."""
        return segment2.midpoint(self.ends)

    @property
    def direction(self) -> FloatArray:
        """(N, 2) unit directions."""
        return segment2.direction(self.ends)

    @property
    def line(self) -> FloatArray:
        """(N, 3) homogeneous lines; positive on the right, the brighter side."""
        return segment2.to_line(self.ends)

    def select(self, rows: IntArray | BoolArray) -> Segments:
        """Segments of the given rows: indices or a mask."""
        return Segments(self.ends[rows], self.sigma[rows], self.strength[rows], self.contrast[rows])

    @staticmethod
    def joined(parts: Sequence[Segments]) -> Segments:
        """Segments of several parts, one after the other."""
        parts = [Segments.empty(), *parts]
        return Segments(*(np.concatenate([getattr(one, item.name) for one in parts]) for item in fields(Segments)))

    @staticmethod
    def ranked(
        ends: FloatArray, sigma: FloatArray, strength: FloatArray, size: tuple[int, ...], min_length: float,
        min_strength: float,
    ) -> Segments:  # fmt: skip
        """Segments cut off at the border of an image of a size (height, width), the longest first.

        Shorter or weaker ones are left out.
        """
        ends = np.clip(ends, 0.0, np.array(size[::-1] * 2, np.float64))
        length = np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1])
        rows = np.flatnonzero((length >= min_length) & (strength >= min_strength))
        rows = rows[np.lexsort((ends[rows, 1], ends[rows, 0], -length[rows]))]
        return Segments(ends[rows], sigma[rows], strength[rows])

    @staticmethod
    def from_ends(ends: FloatArray, sigma: float = 0.3) -> Segments:
        """Segments from end points (N, 4) of another detector, with one sigma in pixels for all.

        Their direction is kept as given; the darker side must lie on the left where matching is to use it.
        """
        ends = np.asarray(ends, dtype=np.float64).reshape(-1, 4)
        return Segments(ends, np.full(len(ends), float(sigma)), np.zeros(len(ends)))

    @staticmethod
    def empty() -> Segments:
        """No segments."""
        return Segments(np.zeros((0, 4)), np.zeros(0), np.zeros(0))
