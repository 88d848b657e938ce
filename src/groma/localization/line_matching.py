# SPDX-License-Identifier: BSD-3-Clause
"""Segments of a query that may show lines of a map: by their surroundings, and where a pose says the lines are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._numba import loop, unrolled_loop
from groma._typing import BoolArray, FloatArray, IntArray
from groma.features.matching.descriptor import Descriptors
from groma.features.matching.wide_baseline import WideBaselineOptions
from groma.features.segments import SEGMENTS, Segments
from groma.localization.pose.camera import QueryCamera, pose_matrix


# ---------------------------------------------------------------------------------------------------------- Kernels
@loop
def _near(lines, segments, order, middle, beyond, reach, angle, overlap, rows, columns):
    """Pairs of images of lines and segments that are near, of about one direction, and side by side.

    Segments are in the order of their middles, along either axis of the image: only those are looked at whose middles
    may lie beside the line, or beyond its ends by no more than so much. The number of pairs that is returned may be
    more than the arrays hold.
    """
    count = 0
    for i in range(lines.shape[0]):
        u, v = lines[i, 0, 0], lines[i, 0, 1]
        du, dv = lines[i, 1, 0] - u, lines[i, 1, 1] - v
        length = max(np.sqrt(du * du + dv * dv), 1e-9)
        du, dv = du / length, dv / length
        axis = 0 if abs(du) <= abs(dv) else 1
        margin = reach + beyond * min(abs(du), abs(dv))
        low, high = min(lines[i, 0, axis], lines[i, 1, axis]), max(lines[i, 0, axis], lines[i, 1, axis])
        begin = np.searchsorted(middle[axis], low - margin)
        for at in range(begin, segments.shape[0]):
            if not middle[axis, at] <= high + margin:
                break
            k = order[axis, at]
            x, y = segments[k, 0, 0] - u, segments[k, 0, 1] - v
            across = y * du - x * dv
            if not (-reach <= across <= reach):
                continue
            x2, y2 = segments[k, 1, 0] - u, segments[k, 1, 1] - v
            other = y2 * du - x2 * dv
            if not (-reach <= other <= reach):
                continue
            first, second = x * du + y * dv, x2 * du + y2 * dv
            own = max(np.sqrt((other - across) ** 2 + (second - first) ** 2), 1e-9)
            if abs(other - across) > angle * own:
                continue
            common = min(max(first, second), length) - max(min(first, second), 0.0)
            if common < overlap * own:
                continue
            if count < len(rows):
                rows[count], columns[count] = i, k
            count += 1
    return count


@unrolled_loop
def _most_alike(rows, columns, begin, of_lines, of_segments, out):
    """Largest product of a descriptor of a line with that of a segment, for each pair."""
    for n in range(rows.shape[0]):
        best = np.float32(-1.0)
        for k in range(begin[rows[n]], begin[rows[n] + 1]):
            product = np.float32(0.0)
            for j in range(of_lines.shape[1]):
                product += of_lines[k, j] * of_segments[columns[n], j]
            best = max(best, product)
        out[n] = best


@loop
def _project(ends, R_t, K, out, visible):
    """Images of segments (L, 2, 3), cut before the camera, and which are in front of it."""
    P = np.empty((2, 3))
    for n in range(ends.shape[0]):
        for i in range(2):
            for j in range(3):
                P[i, j] = R_t[j, 3]
                for k in range(3):
                    P[i, j] += R_t[j, k] * ends[n, i, k]
        least = 1e-3 * max(abs(P[0, 2]), abs(P[1, 2]))
        visible[n] = P[0, 2] >= least or P[1, 2] >= least
        for i in range(2):
            share, depth = 0.0, P[i, 2]
            if depth < least and visible[n]:
                share = min(max((least - depth) / (P[1 - i, 2] - depth), 0.0), 1.0)
            z = depth + share * (P[1 - i, 2] - depth)
            for j in range(2):
                place = (P[i, j] + share * (P[1 - i, j] - P[i, j])) / z
                out[n, i, j] = (place if visible[n] else 1.0) * K[j, j] + K[j, 2]


# ----------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True, eq=False)
class SeenLines:
    """Lines of a map, each with descriptors from some of its images."""

    #: (n,) the line that each descriptor belongs to, as a row of the segments below; (n, 72) descriptors.
    owner: IntArray
    descriptors: Descriptors
    #: (L, 2, 3) ends of the 3D segments.
    ends: FloatArray


def lines_near(
    camera: QueryCamera, pose: FloatArray, seen: SeenLines, segments: Segments, descriptors: Descriptors, reach: float
) -> IntArray:
    """Return pairs (n, 2) of lines and segments that are near each other under a pose, and look alike.

    Parameters
    ----------
    camera, pose : QueryCamera, (7,)
        Where the image was taken from.
    seen
        Lines of the map.
    segments, descriptors
        Of the image.
    reach
        Largest distance of a segment's ends from the image of the line, pixels.
    """
    if not len(segments) or not len(seen.ends) or not len(seen.owner):
        return np.zeros((0, 2), np.int64)
    straight = camera.straight(segments.ends.reshape(-1, 2)).reshape(-1, 2, 2)
    if np.isnan(straight).all():
        return np.zeros((0, 2), np.int64)
    projected, visible = _projected(camera, pose, seen.ends)
    low, high = np.nanmin(straight, axis=(0, 1)) - reach, np.nanmax(straight, axis=(0, 1)) + reach
    touches = (projected.max(axis=1) >= low) & (projected.min(axis=1) <= high)
    chosen = np.flatnonzero(visible & touches.all(axis=1))
    rows, columns = _pairs_near(np.ascontiguousarray(projected[chosen]), straight, reach)
    order = np.argsort(seen.owner, kind="stable")
    begin = np.searchsorted(seen.owner[order], np.arange(len(seen.ends) + 1))
    product = np.empty(len(rows), np.float32)
    of_lines, of_segments = (np.ascontiguousarray(x, np.float32) for x in (seen.descriptors[order], descriptors))
    _most_alike(chosen[rows], columns, begin, of_lines, of_segments, product)
    alike = (
        np.sqrt(np.maximum(2.0 - 2.0 * product.astype(np.float64), 0.0)) <= WideBaselineOptions.max_descriptor_distance
    )
    return np.column_stack([chosen[rows[alike]], columns[alike]])


def _pairs_near(lines: FloatArray, segments: FloatArray, reach: float) -> tuple[IntArray, IntArray]:
    middle = segments.mean(axis=1).T
    order = np.argsort(middle, axis=1, kind="stable")
    middle = np.take_along_axis(middle, order, axis=1)
    longest = float(np.nanmax(np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)))
    beyond = max(0.5 - SEGMENTS.overlap, 0.0) * longest
    count = 4 * len(segments)
    while True:
        rows, columns = np.empty((2, count), np.int64)
        found = _near(lines, segments, order, middle, beyond, reach, SEGMENTS.angle, SEGMENTS.overlap, rows, columns)
        if found <= count:
            return rows[:found], columns[:found]
        count = found


def _projected(camera: QueryCamera, pose: FloatArray, ends: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Images (L, 2, 2) of 3D segments without distortion, cut before the camera; and which are in front of it."""
    projected, visible = np.empty((len(ends), 2, 2)), np.empty(len(ends), bool)
    _project(np.ascontiguousarray(ends), pose_matrix(pose), camera.matrix, projected, visible)
    return projected, visible
