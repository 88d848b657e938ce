# SPDX-License-Identifier: BSD-3-Clause
r"""Match segments between images taken from quite different places.

Three kinds of evidence, each weak alone:

* **Surroundings.** The distance of the gradient-band descriptors.
* **Points.** Points matched between the images that lie near both segments, on the same side of both; a point on
  opposite sides contradicts.
* **Epipolar geometry**, where the relative pose is known. The end points :math:`x_1, x_2` of the first segment and
  :math:`p, q` of the second enter only through the four numbers

  .. math:: m = \begin{bmatrix} p^\top F x_1 & p^\top F x_2 \\ q^\top F x_1 & q^\top F x_2 \end{bmatrix}

  If all four have one sign, the second segment lies outside the epipolar beam of the first and cannot show the same
  piece of an edge. A row changes sign where the epipolar line of p or q cuts the first segment, a column where that of
  :math:`x_1` or :math:`x_2` cuts the second: so the same numbers give the overlap on both, and say whether the two
  run the same way. As segments are directed by their dark side, those that do not are no match.

A candidate's evidence is turned into a probability, and a match must be the best of both its segments by a margin.

References
----------
Fan, Wu and Hu, *Robust line matching through line-point invariants*, 2012, for points on the same side;
Schmid and Zisserman, *Automatic line matching across views*, 1997, for the epipolar beam. Deviations: the points'
distances are compared by sign and ratio only, and all evidence is combined by one logistic function.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groma._numba import inline_kernel, kernel, loop
from groma._typing import FloatArray, IntArray
from groma.errors import InputError, ShapeError, check_kind, given_or_default
from groma.features.matches import LineMatches, mutual_best
from groma.features.matching.descriptor import Descriptors
from groma.features.matching.nearby import NearbyPoints, nearby_points
from groma.features.segments import SEGMENTS, Segments
from groma.gates import gate
from groma.geometry.algebra import matrices, numbers

#: Rows of the table of descriptor products held in memory (cost: memory).
ROWS_AT_ONCE = 512
_SURVEYED = "chosen on Strecha's surveyed scenes"
#: Columns of a row, whose format is: descriptor distance; points for, against, near one only; overlap on first, on
#: second (-1: unknown).
FEATURES = 6


@dataclass(frozen=True)
class WideBaselineOptions:
    """What counts as a match."""

    #: Candidates farther apart are skipped.
    max_descriptor_distance: float = 0.9
    #: Smallest epipolar overlap, as a share of the smaller extent; only with a fundamental matrix.
    min_overlap: float = SEGMENTS.overlap
    #: How far outside the epipolar beam an end point may lie, pixels.
    beam_tolerance: float = 2.0
    #: Points within this distance of a segment support it, pixels.
    reach: float = 40.0
    #: Smallest score of a match.
    min_score: float = 0.5
    #: By how much a match must beat any rival, logarithm of odds: 0.7 is twice as likely.
    margin: float = 0.7


@dataclass(frozen=True)
class EvidenceGates:
    """Weights of the logarithm of the odds that a candidate is right.

    They best rank, for each segment, the candidate whose triangulated line is seen in two further images above all
    others.
    """

    bias: float = gate(1.5, "log odds", "identical surroundings without points or overlap", _SURVEYED)
    descriptor: float = gate(6.2, "log odds", "for a distance of one of the descriptors", _SURVEYED)
    points_for: float = gate(2.9, "log odds", "for the logarithm of one and the points on the same side", _SURVEYED)
    points_against: float = gate(0.25, "log odds", "for that of the points on opposite sides", _SURVEYED)
    points_missing: float = gate(0.3, "log odds", "for that of the points near one of them only", _SURVEYED)
    overlap: float = gate(2.4, "log odds", "for the whole epipolar overlap", _SURVEYED)
    unknown_overlap: float = gate(-0.25, "share", "stands for an overlap that is not known", _SURVEYED)
    min_extent: float = gate(4.0, "beam tolerances", "extents across epipolar lines that give an overlap", _SURVEYED)


#: The weights in use.
EVIDENCE = EvidenceGates()


# -------------------------------------------------------------------------------------------------------- Kernels
@kernel
def _share(a, b):
    """Overlap of the interval from a to b with 0 to 1, as a share of the shorter of the two."""
    low, high = min(a, b), max(a, b)
    common = min(high, 1.0) - max(low, 0.0)
    return max(common, 0.0) / max(min(high - low, 1.0), 1e-12)


@kernel
def _crossing(a, b):
    """Where a value that goes from a (at 0) to b (at 1) is zero."""
    return a / (a - b)


@kernel
def _points(ids_1, distance_1, low_1, high_1, ids_2, distance_2, low_2, high_2, on_line, out):
    """Shared points on the same side, by how alike their distances are; on opposite sides; and points not shared."""
    i, j = low_1, low_2
    for_it = 0.0
    against = 0.0
    shared = 0
    while i < high_1 and j < high_2:
        if ids_1[i] < ids_2[j]:
            i += 1
        elif ids_1[i] > ids_2[j]:
            j += 1
        else:
            one, two = distance_1[i], distance_2[j]
            if abs(one) < on_line or abs(two) < on_line:
                # On the line: no side, but a point close to both supports them.
                if abs(one) < 2.0 * on_line and abs(two) < 2.0 * on_line:
                    for_it += 1.0
                else:
                    against += 0.5
            elif one * two > 0.0:
                ratio = min(abs(one), abs(two)) / max(abs(one), abs(two))
                for_it += ratio
            else:
                against += 1.0
            shared += 1
            i += 1
            j += 1
    out[0], out[1] = for_it, against
    out[2] = min(high_1 - low_1, high_2 - low_2) - shared


@inline_kernel
def _epipolar_line(F, u, v):
    """Return the epipolar line of a pixel, scaled so that a product with (u, v, 1) is a distance in pixels."""
    a0, a1, a2 = (
        F[0, 0] * u + F[0, 1] * v + F[0, 2],
        F[1, 0] * u + F[1, 1] * v + F[1, 2],
        F[2, 0] * u + F[2, 1] * v + F[2, 2],
    )
    scale = 1.0 / max(math.hypot(a0, a1), 1e-300)
    return a0 * scale, a1 * scale, a2 * scale


@inline_kernel
def _overlaps(a, b, ends, j, min_overlap, tolerance, min_extent):
    """Return whether segment j can lie between two epipolar lines, and the shares of both segments that overlap.

    Shares are -1 where the geometry does not determine them.
    """
    on_1 = -1.0
    on_2 = -1.0
    u, v = ends[j, 0], ends[j, 1]
    pa, pb = a[0] * u + a[1] * v + a[2], b[0] * u + b[1] * v + b[2]
    u, v = ends[j, 2], ends[j, 3]
    qa, qb = a[0] * u + a[1] * v + a[2], b[0] * u + b[1] * v + b[2]
    if min(min(pa, pb), min(qa, qb)) > tolerance or max(max(pa, pb), max(qa, qb)) < -tolerance:
        return False, on_1, on_2
    # Extents in pixels: of the second across the epipolar lines, of the beam at the second.
    turn, beam = 0.5 * ((qa - pa) + (qb - pb)), 0.5 * ((pa - pb) + (qa - qb))
    if abs(turn) > min_extent and abs(beam) > min_extent:
        if turn * beam < 0.0:
            return False, on_1, on_2
        if pa != qa and pb != qb:
            on_2 = _share(_crossing(pa, qa), _crossing(pb, qb))
        if pa != pb and qa != qb:
            on_1 = _share(_crossing(pa, pb), _crossing(qa, qb))
        if min(on_1, on_2) < min_overlap:
            return False, on_1, on_2
    return True, on_1, on_2


@loop
def _candidates(
    first_row, ends_1, ends_2, products, begin_1, ids_1, distance_1, begin_2, ids_2, distance_2,
    F, has_F, min_overlap, tolerance, min_extent, on_line, min_product,
):  # fmt: skip
    """Pairs of a stretch of rows that pass the gates: indices (C, 2) and features (C, 6)."""
    n1, n2 = products.shape
    room = 16 * (n1 + 16)
    pairs, features = np.zeros((room, 2), dtype=np.int64), np.zeros((room, FEATURES))
    count = 0
    points = np.zeros(3)
    for row in range(n1):
        i = first_row + row
        a = b = (0.0, 0.0, 0.0)
        if has_F:
            a = _epipolar_line(F, ends_1[i, 0], ends_1[i, 1])
            b = _epipolar_line(F, ends_1[i, 2], ends_1[i, 3])
        for j in range(n2):
            product = products[row, j]
            if product < min_product:
                continue
            on_1 = -1.0
            on_2 = -1.0
            if has_F:
                possible, on_1, on_2 = _overlaps(a, b, ends_2, j, min_overlap, tolerance, min_extent)
                if not possible:
                    continue
            _points(
                ids_1, distance_1, begin_1[i], begin_1[i + 1], ids_2, distance_2, begin_2[j], begin_2[j + 1], on_line,
                points,
            )  # fmt: skip
            if count == room:
                more_pairs, more_features = np.zeros((2 * room, 2), dtype=np.int64), np.zeros((2 * room, FEATURES))
                more_pairs[:room], more_features[:room] = pairs, features
                pairs, features, room = more_pairs, more_features, 2 * room
            pairs[count, 0], pairs[count, 1] = i, j
            features[count, 0] = math.sqrt(max(2.0 - 2.0 * product, 0.0))
            features[count, 1], features[count, 2], features[count, 3] = points[0], points[1], points[2]
            features[count, 4], features[count, 5] = on_1, on_2
            count += 1
    return pairs[:count], features[:count]


# --------------------------------------------------------------------------------------------------------- Public
def match_wide_baseline(
    segments_1: Segments,
    segments_2: Segments,
    descriptors_1: Descriptors,
    descriptors_2: Descriptors,
    point_matches: FloatArray | tuple[NearbyPoints, NearbyPoints] | None = None,
    fundamental: FloatArray | None = None,
    options: WideBaselineOptions | None = None,
) -> LineMatches:
    """Match segments by their surroundings, the points near them and, where known, the epipolar geometry.

    Parameters
    ----------
    segments_1, segments_2 : Segments
        Segments of the two images.
    descriptors_1, descriptors_2 : (N, 72) float32
        From :func:`groma.features.matching.descriptor.describe`.
    point_matches : (K, 4) float64, or two NearbyPoints, optional
        Matched points u1 v1 u2 v2 in pixels; or what :func:`groma.features.matching.nearby.nearby_points` made once for
        each image, with common identifiers.
    fundamental : (3, 3) float64, optional
        Fundamental matrix, x2^T F x1 = 0 for matching pixels (see :func:`fundamental_from_poses`).
    options : WideBaselineOptions, optional
        Gates and thresholds.

    Returns
    -------
    LineMatches
        One to one; the score is an estimate of the probability that the match is right.

    Raises
    ------
    ShapeError
        If an array has another shape.
    InputError
        If the fundamental matrix is zero or not finite.

    Notes
    -----
    Segments that run along their epipolar lines (within 4 times the tolerance across them) have no overlap to speak
    of; they are matched by surroundings and points, inside the beam. The memory used is that of the candidates, which
    the beam and the descriptor bound; the time is that of one cheap test for each pair of segments.
    """
    options = given_or_default(options, WideBaselineOptions)
    pairs, features = candidates(
        segments_1, segments_2, descriptors_1, descriptors_2, point_matches, fundamental, options
    )
    evidence = _evidence(features)
    score = 1.0 / (1.0 + np.exp(-np.clip(evidence, -50.0, 50.0)))
    good = score >= options.min_score
    first, second = pairs[good, 0], pairs[good, 1]
    return mutual_best(first, second, score[good], evidence[good], segments_1, segments_2, options.margin)


def candidates(
    segments_1: Segments,
    segments_2: Segments,
    descriptors_1: Descriptors,
    descriptors_2: Descriptors,
    point_matches: FloatArray | tuple[NearbyPoints, NearbyPoints] | None,
    fundamental: FloatArray | None,
    options: WideBaselineOptions,
) -> tuple[IntArray, FloatArray]:
    """Pairs (C, 2) that pass the gates and their evidence (C, 6); see :func:`match_wide_baseline`."""
    one, two = _descriptors(descriptors_1, segments_1, 1), _descriptors(descriptors_2, segments_2, 2)
    if isinstance(point_matches, tuple):
        near_1, near_2 = point_matches
        for near, segments in ((near_1, segments_1), (near_2, segments_2)):
            if len(near.begin) != len(segments) + 1:
                raise ShapeError(f"NearbyPoints must be of these {len(segments)} segments; got {len(near.begin) - 1}.")
        near_1, near_2 = near_1.common_with(near_2), near_2.common_with(near_1)
    else:
        points = np.zeros((0, 4)) if point_matches is None else np.asarray(point_matches, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 4:
            raise ShapeError(f"point_matches must have shape (K, 4): u1 v1 u2 v2; got {points.shape}.")
        ids = np.arange(len(points))
        near_1 = nearby_points(segments_1, points[:, :2], ids, options.reach)
        near_2 = nearby_points(segments_2, points[:, 2:], ids, options.reach)
    F = np.zeros((3, 3)) if fundamental is None else np.ascontiguousarray(fundamental, dtype=np.float64)
    if F.shape != (3, 3):
        raise ShapeError(f"fundamental must have shape (3, 3); got {F.shape}.")
    if fundamental is not None and not (np.isfinite(F).all() and np.abs(F).max() > 0.0):
        raise InputError("fundamental must be finite and not zero; pass None where the relative pose is not known.")
    least = np.float32(1.0 - 0.5 * options.max_descriptor_distance**2)
    pairs, features = [np.zeros((0, 2), dtype=np.int64)], [np.zeros((0, FEATURES))]
    for row in range(0, len(one), ROWS_AT_ONCE):
        found = _candidates(
            row, segments_1.ends, segments_2.ends, one[row : row + ROWS_AT_ONCE] @ two.T,
            near_1.begin, near_1.point_id, near_1.distance, near_2.begin, near_2.point_id, near_2.distance,
            F, fundamental is not None, options.min_overlap, options.beam_tolerance,
            EVIDENCE.min_extent * options.beam_tolerance, SEGMENTS.on, least,
        )  # fmt: skip
        pairs.append(found[0])
        features.append(found[1])
    return np.concatenate(pairs), np.concatenate(features)


def fundamental_from_poses(
    cam1_from_world: FloatArray, cam2_from_world: FloatArray, K1: FloatArray, K2: FloatArray
) -> FloatArray:
    r"""Fundamental matrix of two pinhole images.

    .. math:: F = K_2^{-\top}\,[t]_\times R\,K_1^{-1}, \qquad x_2^\top F\,x_1 = 0

    Parameters
    ----------
    cam1_from_world, cam2_from_world : (3, 4) float64
        Poses [R | t].
    K1, K2 : (3, 3) float64
        Calibration matrices, pixels.

    Returns
    -------
    (3, 3) float64
        Zero where the camera centres coincide.
    """
    cam1_from_world, cam2_from_world = (
        matrices(pose, 3, 4, f"cam{n}_from_world") for n, pose in ((1, cam1_from_world), (2, cam2_from_world))
    )
    K1, K2 = matrices(K1, 3, 3, "K1"), matrices(K2, 3, 3, "K2")
    R = cam2_from_world[:, :3] @ cam1_from_world[:, :3].T
    t = cam2_from_world[:, 3] - R @ cam1_from_world[:, 3]
    cross = np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]])
    return np.linalg.inv(K2).T @ cross @ R @ np.linalg.inv(K1)


def _descriptors(descriptors: Descriptors, segments: Segments, which: int) -> npt.NDArray[np.float32]:
    check_kind(segments, Segments, f"segments_{which}", "Detect them: groma.features.LsdDetector().detect(image).")
    descriptors = np.ascontiguousarray(numbers(descriptors, f"descriptors_{which}"), dtype=np.float32)
    if descriptors.ndim != 2 or len(descriptors) != len(segments):
        raise ShapeError(
            f"descriptors_{which} must have shape ({len(segments)}, D), one row a segment; got {descriptors.shape}."
        )
    return descriptors


def _evidence(features: FloatArray) -> FloatArray:
    """Logarithm of the odds that a candidate is right."""
    w = EVIDENCE
    distance, for_it, against, missing, on_1, on_2 = features.T
    known = on_1 >= 0.0
    overlap = np.where(known, np.sqrt(np.maximum(on_1, 0.0) * np.maximum(on_2, 0.0)), w.unknown_overlap)
    points = w.points_for * np.log1p(for_it) - w.points_against * np.log1p(against)
    points -= w.points_missing * np.log1p(missing)
    return w.bias - w.descriptor * distance + points + w.overlap * overlap
