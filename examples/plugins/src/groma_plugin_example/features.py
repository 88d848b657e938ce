# SPDX-License-Identifier: BSD-3-Clause
"""A segment detector, a segment matcher and an image retrieval: toys that keep the contracts."""

from dataclasses import dataclass

import cv2
import numpy as np

from groma.features import LineMatches, Segments
from groma.features.edge_fit import measure_edges
from groma.features.images import to_gray


@dataclass(frozen=True)
class HoughDetector:
    """Edges by Canny, straight pieces by the Hough transform, then fitted to the grey levels."""

    #: Shortest segment, pixels.
    min_length: float = 20.0
    #: Keep at most so many, the longest; 0 keeps all.
    max_segments: int = 0

    def detect(self, image):
        gray = to_gray(image)
        found = cv2.HoughLinesP(cv2.Canny(gray, 40, 120), 1.0, np.pi / 360.0, 25, None, self.min_length, 3.0)
        if found is None:
            return Segments.empty()
        # The same edge is found several times: the longest stays, others beside it go.
        ends = found.reshape(-1, 4).astype(np.float64) + 0.5
        length = np.hypot(*(ends[:, 2:] - ends[:, :2]).T)
        kept = []
        for row in np.argsort(-length, kind="stable"):
            if not _is_along_one(ends[row], ends[kept]):
                kept.append(row)
        ends, sigma, strength = measure_edges(gray, ends[kept[: self.max_segments or None]])
        good = np.hypot(*(ends[:, 2:] - ends[:, :2]).T) >= self.min_length
        return Segments(ends[good], sigma[good], strength[good])


def _is_along_one(short, others):
    """Whether both ends of a segment lie within two pixels of one of the others (n, 4)."""
    along = (others[:, 2:] - others[:, :2]) / np.hypot(*(others[:, 2:] - others[:, :2]).T)[:, None]
    offset = short.reshape(2, 1, 2) - others[:, :2]
    return bool((np.abs(offset[..., 0] * along[:, 1] - offset[..., 1] * along[:, 0]) < 2.0).all(axis=0).any())


@dataclass(frozen=True)
class NearestMatcher:
    """Segments are one edge if their middles are nearest to each other and they run alike: for small steps."""

    #: Largest distance of the middles, pixels, and largest angle, radians.
    reach: float = 40.0
    max_angle: float = 0.1

    def describe(self, view):
        ends = view.segments.ends
        return 0.5 * (ends[:, :2] + ends[:, 2:]), np.arctan2(*(ends[:, 2:] - ends[:, :2]).T)

    def match(self, first, second):
        (middle_1, angle_1), (middle_2, angle_2) = first, second
        if not len(middle_1) or not len(middle_2):
            return LineMatches.empty()
        distance = np.linalg.norm(middle_1[:, None] - middle_2, axis=2)
        turn = np.abs(np.mod(angle_1[:, None] - angle_2 + np.pi, 2.0 * np.pi) - np.pi)
        distance[(turn > self.max_angle) | (distance > self.reach)] = np.inf
        one, two = np.arange(len(middle_1)), distance.argmin(axis=1)
        mutual = (distance.argmin(axis=0)[two] == one) & np.isfinite(distance[one, two])
        return LineMatches(np.column_stack([one, two])[mutual], np.exp(-distance[one, two] / self.reach)[mutual])


@dataclass(frozen=True)
class ThumbnailRetrieval:
    """Images are alike if their thumbnails are."""

    #: (width, height) of a thumbnail, pixels.
    size: tuple[int, int] = (24, 18)

    def describe(self, image):
        small = cv2.resize(to_gray(image), self.size, interpolation=cv2.INTER_AREA).astype(np.float64).ravel()
        small -= small.mean()
        return small / max(np.linalg.norm(small), 1e-9)

    def similarity(self, query, others):
        return np.array([float(query @ other) for other in others])
