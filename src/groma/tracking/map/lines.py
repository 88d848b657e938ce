# SPDX-License-Identifier: BSD-3-Clause
"""Segments of one frame and the lines of the map: which is which.

Between keyframes a line is *followed*: points along its last segment are carried by coarse dense flow and vote for
where it went, and the edge is then measured in the image (:mod:`groma.features.edge_fit`). At keyframes segments are
*detected* and assigned to lines by their predicted images: near, parallel, the dark side on the same hand,
overlapping, and best for both. A depth measured along the segment must agree too.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from groma._numba import loop
from groma._rows import Rows, column
from groma._typing import BoolArray, FloatArray, IntArray
from groma.features.edge_fit import measure_smoothed
from groma.features.images import GrayImage, SmoothImage
from groma.features.matching.flow import Flow
from groma.features.segments import SEGMENTS
from groma.geometry import quaternion, se3, segment2
from groma.tracking.frame.camera import TrackCamera, into
from groma.tracking.gates import DEFAULT, LineGates
from groma.tracking.map.landmarks import LineTable


@loop
def _score_all(expected, ends, limits, score):
    """Write the mean distance of the ends of segments from expected lines; infinity where they are another line.

    Rows are: ends, direction, length, inverse depth of the middle or NaN.
    """
    max_distance, min_cosine, min_overlap, depth_share = limits
    for i in range(expected.shape[0]):
        x, y, dx, dy = expected[i, 0], expected[i, 1], expected[i, 4], expected[i, 5]
        length, inverse = expected[i, 6], expected[i, 7]
        for j in range(ends.shape[0]):
            score[i, j] = np.inf
            if not dx * ends[j, 4] + dy * ends[j, 5] > min_cosine:
                continue
            u, v, s, t = ends[j, 0] - x, ends[j, 1] - y, ends[j, 2] - x, ends[j, 3] - y
            first, second = abs(dx * v - dy * u), abs(dx * t - dy * s)
            if not max(first, second) < max_distance:
                continue
            begin, end = dx * u + dy * v, dx * s + dy * t
            overlap = min(max(begin, end), length) - max(min(begin, end), 0.0)
            if not overlap > min_overlap * min(length, ends[j, 6]):
                continue
            if abs(inverse - ends[j, 7]) > depth_share * max(inverse, ends[j, 7]):
                continue
            score[i, j] = 0.5 * (first + second)


def coarse_flow(image_1: GrayImage, image_2: GrayImage, reduction: int) -> Flow:
    """Dense flow (h, w, 2) of images reduced by a factor, in pixels of the full ones."""
    height, width = image_1.shape
    size = (max(width // reduction, 32), max(height // reduction, 32))
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (image_1, image_2)]
    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    flow = method.calc(small[0], small[1], None)  # pyright: ignore[reportCallIssue, reportArgumentType]
    return np.asarray(flow, np.float32) * np.array([width / size[0], height / size[1]], np.float32)


@dataclass(frozen=True, eq=False)
class FollowedSegments(Rows):
    """Segments of known lines in a frame."""

    #: (n,) landmark of each.
    index: IntArray = column(dtype=np.int64)
    #: (n, 4) segments, (n,) standard deviation and edge strength.
    ends: FloatArray = column(4)
    sigma: FloatArray = column()
    strength: FloatArray = column()


def carried(
    flow: Flow, ends: FloatArray, shape: tuple[int, int], gates: LineGates = DEFAULT.lines
) -> tuple[FloatArray, BoolArray]:
    """Segments carried by flow: the line that most of their points vote for, and whether they agree."""
    t = (np.arange(gates.voters) + 0.5) / gates.voters - 0.5
    middle, half = 0.5 * (ends[:, :2] + ends[:, 2:]), ends[:, 2:] - ends[:, :2]
    points = middle[:, None] + t[:, None] * half[:, None]
    height, width = flow.shape[:2]
    column = np.clip((points[..., 0] * width / shape[1]).astype(np.int64), 0, width - 1)
    row = np.clip((points[..., 1] * height / shape[0]).astype(np.int64), 0, height - 1)
    shift = flow[row, column].astype(np.float64)
    # Displacement linear along the segment, refitted without the points that disagree.
    weight = np.ones(shift.shape[:2])
    base = np.median(shift, axis=1)
    slope = np.zeros_like(base)
    for gate in gates.vote_distances:
        away = np.linalg.norm(shift - base[:, None] - t[:, None] * slope[:, None], axis=2)
        weight = (away < gate).astype(float)
        s0, s1, s2 = weight.sum(1), (weight * t).sum(1), (weight * t * t).sum(1)
        det = np.maximum(s0 * s2 - s1 * s1, 1e-6)
        r0, r1 = (weight[..., None] * shift).sum(1), ((weight * t)[..., None] * shift).sum(1)
        base = (s2[:, None] * r0 - s1[:, None] * r1) / det[:, None]
        slope = (s0[:, None] * r1 - s1[:, None] * r0) / det[:, None]
    good = weight.sum(axis=1) >= 0.5 * gates.voters
    return ends + np.hstack([base - 0.5 * slope, base + 0.5 * slope]), good


def measured_edges(
    smooth: SmoothImage, guess: FloatArray, strength: FloatArray, gates: LineGates
) -> tuple[FollowedSegments, IntArray]:
    """Fit guessed segments to the smoothed image; keep those with an edge of the right sign and like strength.

    Returns the segments (their index is the row of the guess), and those rows.
    """
    ends, sigma, found = measure_smoothed(smooth, guess)
    same_way = ((ends[:, 2:] - ends[:, :2]) * (guess[:, 2:] - guess[:, :2])).sum(axis=1) > 0
    good = same_way & (sigma < gates.max_sigma) & (found > gates.min_strength)
    good &= (found > gates.weaker * strength) & (found < gates.stronger * strength)
    rows = np.flatnonzero(good)
    return FollowedSegments(rows, ends[rows], sigma[rows], found[rows]), rows


def expected_segments(
    camera: TrackCamera, lines: LineTable, rows: IntArray, pose: FloatArray, gates: LineGates
) -> tuple[FloatArray, BoolArray]:
    """Where lines of the map should appear (n, 4), and which of them are in view with a length worth looking at."""
    ends, seen = camera.project_segments(into(pose, lines.segment[rows]), border=gates.border)
    return ends, seen & (segment2.length(ends) > gates.min_length)


def assign(
    expected: FloatArray,
    ends: FloatArray,
    max_distance: float,
    max_angle: float,
    expected_inverse: FloatArray | None = None,
    inverse: FloatArray | None = None,
    gates: LineGates = DEFAULT.lines,
) -> tuple[IntArray, IntArray]:
    """Pair expected segments (N, 4) with detected ones (M, 4): one to one, best for both.

    Parameters
    ----------
    expected, ends : (N, 4), (M, 4)
        Directed segments, pixels.
    max_distance : float
        Largest distance of the detected ends and middle from the expected line, pixels.
    max_angle : float
        Largest angle, radians.
    expected_inverse, inverse : (N,), (M,), optional
        Inverse depths of the middles; where both are known they must agree.
    gates : LineGates
        How well the rest must agree.

    Returns
    -------
    (k,), (k,) int
        Rows of the pairs.
    """
    none = np.zeros(0, np.int64)
    if not len(expected) or not len(ends):
        return none, none
    one, two = _described(expected, expected_inverse), _described(ends, inverse)
    score = np.empty((len(one), len(two)))
    limits = float(max_distance), float(np.cos(max_angle)), float(SEGMENTS.overlap), float(gates.depth_share)
    _score_all(one, two, limits, score)
    best = np.argmin(score, axis=1)
    rows = np.flatnonzero(np.isfinite(score[np.arange(len(expected)), best]))
    mutual = np.argmin(score, axis=0)[best[rows]] == rows
    # A rival nearly as good makes the pair ambiguous; rivals that continue the same line do not.
    rows = rows[mutual]
    return rows, best[rows]


def _described(ends: FloatArray, inverse: FloatArray | None) -> FloatArray:
    """Rows of :func:`_score_all`."""
    known = np.full(len(ends), np.nan) if inverse is None else inverse
    way, length = ends[:, 2:] - ends[:, :2], segment2.length(ends)
    return np.column_stack([ends, way / np.maximum(length, 1e-9)[:, None], length, known])


def line_ends(
    camera: TrackCamera, poses: FloatArray, plucker: FloatArray, ends: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Points (n, 2, 3) of lines in the world nearest to the rays through their segments' ends, and where defined.

    ``poses`` are those of the cameras that saw each of them (n, 7), or of one that saw all (7,).
    """
    poses = np.broadcast_to(poses, (len(ends), 7))
    size = np.linalg.norm(plucker[:, 3:], axis=1, keepdims=True)
    direction = plucker[:, 3:] / size
    foot = np.cross(direction, plucker[:, :3]) / size
    back = quaternion.conjugate(poses[:, :4])
    away = -quaternion.rotate(back, poses[:, 4:]) - foot
    out = np.zeros((len(ends), 2, 3))
    good = np.ones(len(ends), dtype=bool)
    for k in (0, 1):
        ray = quaternion.rotate(back, camera.bearings(ends[:, 2 * k : 2 * k + 2]))
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        cosine = (ray * direction).sum(axis=1)
        sine2 = 1.0 - cosine**2
        good &= sine2 > 1e-3
        share = ((away * direction).sum(axis=1) - cosine * (away * ray).sum(axis=1)) / np.maximum(sine2, 1e-3)
        out[:, k] = foot + share[:, None] * direction
        good &= se3.transform_points(poses, out[:, k])[:, 2] > 0
    return out, good
