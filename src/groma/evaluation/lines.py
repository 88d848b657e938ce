# SPDX-License-Identifier: BSD-3-Clause
r"""How well 3D line segments agree with a reference: segments, edges, a mesh or points.

Everything follows from two distances: from places on the estimated segments to the reference, and from places on the
reference's segments to the estimate. Distances are exact (point to segment, triangle or point); lengths are measured
by places at equal steps along each segment, so a share of a segment is right to one over its number of places.

Two families of scores are published under nearly the same names. Both are given, at each threshold :math:`\tau`:

========================  =========================================================================================
``recall_length``         share of the *reference's* length that lies within tau of an estimated segment
``covered_length``        the same as a length, in scene units
``inlier_length``         length of the *estimate* that lies within tau of the reference: "length recall R_tau" of
                          LIMAP and of its Hypersim tables. It grows with every further line, also a repeated one
``precision_count``       share of estimated lines of which any part lies within tau: "precision P_tau" of LIMAP
``precision_strict``      share of estimated lines of which at least 90 % lie within tau
``precision_length``      share of the estimate's length that lies within tau
``recall_count``          share of the reference's segments of which at least half lies within tau of the estimate
========================  =========================================================================================

Places at equal steps weigh by length: ``recall_length`` and ``precision_length`` are recall and precision of sampled
edges, as curve drawings and wireframes are judged; those by count are the ones of line maps.

A mesh or a set of points has no length of lines: both recalls and ``covered_length`` are then NaN. Precisions of
an estimate without lines are NaN, its recall is zero.

References
----------
S. Liu et al., *3D Line Mapping Revisited*, CVPR 2023, section 4.1 (R_tau, P_tau).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groma._rows import numbered
from groma._trees import kd_tree
from groma._typing import FloatArray, IntArray
from groma.errors import InputError
from groma.evaluation.gates import SCORES
from groma.evaluation.poses import as_numbers, evaluate_poses
from groma.gates import NORMAL
from groma.geometry.algebra import finite_rows
from groma.io.geometry import Geometry
from groma.scene import Scene
from groma.scene.checks import check_scene_given
from groma.scene.line_intervals import line_pieces

_CHUNK = 100_000


@dataclass(frozen=True)
class LineScores:
    """Agreement of segments with a reference, by threshold (scene units); see the module."""

    #: Share of the reference's length that is covered.
    recall_length: dict[float, float]
    #: Share of lines with any part near the reference.
    precision_count: dict[float, float]
    #: Share of lines with nearly all near the reference.
    precision_strict: dict[float, float]
    #: Share of the estimate's length near the reference.
    precision_length: dict[float, float]
    #: Length of the estimate near the reference.
    inlier_length: dict[float, float]
    #: Length of the reference near the estimate.
    covered_length: dict[float, float]
    #: Share of the reference's segments that are covered by half.
    recall_count: dict[float, float]
    #: Number of estimated lines.
    num_lines: int
    #: Length of the estimate.
    length: float
    #: Length of the reference; NaN for a mesh or points.
    reference_length: float

    def to_dict(self) -> dict[str, object]:
        """Return the scores for a machine-readable report."""
        return as_numbers(self)


def score_lines(
    segments: npt.ArrayLike, reference: Geometry | npt.ArrayLike, thresholds: Sequence[float] | None = None
) -> LineScores:
    """Compare estimated segments with a reference in the same frame and units.

    Parameters
    ----------
    segments : (L, 2, 3) float
        End points of the estimated segments.
    reference : Geometry or (R, 2, 3) float
        The truth. With triangles or points in it, the estimate is compared with all of them together.
    thresholds : sequence of float, optional
        Distances in scene units; by default 1, 5 and 10 thousandths of the reference's extent.

    Raises
    ------
    InputError
        If the reference is empty, a threshold is not positive, or a coordinate is not finite.
    """
    estimate = finite_rows("segments", segments, (2, 3))
    target = reference if isinstance(reference, Geometry) else Geometry(segments=np.asarray(reference, float))
    if len(target) == 0:
        raise InputError("The reference holds no segments, triangles or points. Pass one that does.")
    taus = threshold_list(thresholds, target.extent)
    truth = target.segments
    step, needed = min(taus) / 4, (min(taus), max(taus))
    forth, length = _near(estimate, step, taus, Distances(target, min(taus), *needed))
    total = float(length.sum())
    if len(truth) == len(target):  # segments only
        back, true_length = _near(truth, step, taus, Distances(Geometry(segments=estimate), min(taus), *needed))
        reference_length = float(true_length.sum())
        covered, halves = (back * true_length[:, None]).sum(0), (back >= NORMAL.majority).mean(0)
    else:
        reference_length, covered, halves = np.nan, np.full(len(taus), np.nan), np.full(len(taus), np.nan)
    inlier = (forth * length[:, None]).sum(0)
    shares = [forth > 0, forth >= SCORES.strict_share]
    any_part, nearly_all = (s.mean(0) if len(estimate) else np.full(len(taus), np.nan) for s in shares)
    recall, precision = _ratio(covered, reference_length), _ratio(inlier, total)
    columns = (recall, any_part, nearly_all, precision, inlier, covered, halves)
    by = [dict(zip(taus, np.asarray(values, float).tolist(), strict=True)) for values in columns]
    return LineScores(*by, num_lines=len(estimate), length=total, reference_length=reference_length)


def evaluate_lines(
    estimate: Scene | Geometry,
    reference: Scene | Geometry,
    thresholds: Sequence[float] | None = None,
    align: bool = False,
) -> LineScores:
    """Compare the segments of a scene with those of another, or with edges, a mesh or points.

    Parameters
    ----------
    estimate, reference : Scene or Geometry
        The estimate and the reference; :func:`groma.io.reference.read_reference` reads geometry from files.
    thresholds : sequence of float, optional
        See :func:`score_lines`.
    align : bool
        First bring the estimate into the reference's frame by the poses of the images that are in both scenes.

    Raises
    ------
    InputError
        If geometry without poses is to be aligned, and as :func:`score_lines`.
    """
    check_scene_given(estimate, "estimate", Geometry)
    check_scene_given(reference, "reference", Geometry)
    segments = estimate.segments if isinstance(estimate, Geometry) else line_pieces(estimate)[0]
    if align:
        if isinstance(estimate, Geometry) or isinstance(reference, Geometry):
            raise InputError("Alignment takes the poses of two scenes; geometry alone has none. Pass align=False.")
        segments = evaluate_poses(estimate, reference).alignment.points(segments)
    target = reference if isinstance(reference, Geometry) else Geometry(segments=line_pieces(reference)[0])
    return score_lines(segments, target, thresholds)


def _ratio(part: FloatArray, whole: float) -> FloatArray:
    return np.minimum(part / whole, 1) if whole > 0 else np.full(len(part), np.nan)


def threshold_list(thresholds: Sequence[float] | None, extent: float) -> list[float]:
    """Return distances (scene units) in order; by default 1, 5 and 10 thousandths of an extent.

    Raises
    ------
    InputError
        If a threshold is not positive, or there is no extent to derive one from.
    """
    if thresholds is None:
        if not extent > 0:
            raise InputError("The reference has no extent; pass thresholds in scene units.")
        # Rounded, so that they can be read and typed again.
        return [float(f"{share * extent:.4g}") for share in SCORES.line_shares]
    taus = sorted({float(tau) for tau in thresholds})
    if not taus or not (taus[0] > 0 and taus[-1] < np.inf):
        raise InputError(f"thresholds must be positive distances in scene units; got {list(thresholds)}.")
    return taus


def _near(segments: FloatArray, step: float, taus: list[float], target: Distances) -> tuple[FloatArray, FloatArray]:
    """Return the share of each segment within each threshold, (L, len(taus)), and the lengths."""
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    share = np.zeros((len(segments), len(taus)))
    count = np.clip(np.ceil(length / step), 4, SCORES.max_places).astype(np.int64)
    ends = np.cumsum(count)
    first = 0
    while first < len(segments):
        past = ends[first - 1] if first else 0
        last = max(first + 1, int(np.searchsorted(ends, past + 4 * _CHUNK, side="right")))
        places, owner = places_on(segments[first:last], count[first:last])
        distance = target.of(places)
        for column, tau in enumerate(taus):
            hits = np.bincount(owner[distance <= tau], minlength=last - first)
            share[first:last, column] = hits / count[first:last]
        first = last
    return share, length


def places_on(segments: FloatArray, count: IntArray) -> tuple[FloatArray, IntArray]:
    """Return the midpoints (n, 3) of equal parts of each segment, and the segment of each."""
    owner, inside = numbered(count)
    share = ((inside + 0.5) / count[owner])[:, None]
    return segments[owner, 0] * (1 - share) + segments[owner, 1] * share, owner


class Distances:
    r"""Exact distances from places to the nearest segment, triangle or point of a set.

    Each element is covered by anchors: each of its places is within ``reach`` of one of them. An element whose anchors
    are all farther than :math:`D` is itself farther than :math:`D - \mathrm{reach}`. So the elements of the k
    nearest anchors are looked at, and k grows until the nearest one found is certain, or certain enough.

    Parameters
    ----------
    geometry : Geometry
        The set.
    spacing : float
        Wanted distance of anchors.
    enough, cap : float
        Only between the two distances must be exact: one that is smaller is returned as a number not above
        ``enough``, one that is greater as a number above ``cap``.
    """

    def __init__(self, geometry: Geometry, spacing: float, enough: float = 0.0, cap: float = np.inf) -> None:
        segments, triangles, points = geometry.segments, geometry.triangles, geometry.points
        # A point is a triangle without size; a segment one without width.
        corners = np.concatenate(
            [segments[:, [0, 1, 1]], triangles, np.broadcast_to(points[:, None], (len(points), 3, 3))]
        )
        self.segments, self.triangles = segments, corners
        self.num_segments, self.enough, self.cap = len(segments), enough, cap
        on_line, reach_line, owner_line = _anchors_on_segments(segments, spacing)
        on_face, reach_face, owner_face = _anchors_on_triangles(triangles, spacing)
        anchors = np.concatenate([on_line, on_face, points])
        first = len(segments) + len(triangles)
        self.owner = np.concatenate([owner_line, owner_face + len(segments), first + np.arange(len(points))])
        self.reach = max(reach_line, reach_face)
        self.tree = kd_tree(anchors)

    def of(self, places: FloatArray) -> FloatArray:
        """Return the distance of each place, (n, 3)."""
        result = np.full(len(places), np.inf)
        if self.tree.n == 0:
            return result
        for start in range(0, len(places), _CHUNK):
            self._fill(places[start : start + _CHUNK], result[start : start + _CHUNK])
        return result

    def _fill(self, places: FloatArray, result: FloatArray) -> None:
        open_rows, k = np.arange(len(places)), 4
        size = self.tree.n
        while len(open_rows):
            k = min(k, size)
            known = np.zeros(len(open_rows), bool)
            # Many neighbours of few places at a time: memory stays bounded.
            for part in np.array_split(np.arange(len(open_rows)), max(1, len(open_rows) * k // 2_000_000)):
                rows = open_rows[part]
                distance, found = (table.reshape(-1, k) for table in self.tree.query(places[rows], k))
                exact = self._exact(np.repeat(places[rows], k, axis=0), self.owner[found].ravel()).reshape(-1, k)
                result[rows] = exact.min(1)
                beyond = distance[:, -1] - self.reach
                known[part] = (beyond >= result[rows]) | (beyond > self.cap) | (result[rows] <= self.enough)
            if k == size:
                return
            open_rows = open_rows[~known]
            k *= 4

    def _exact(self, places: FloatArray, owner: IntArray) -> FloatArray:
        distance = np.empty(len(places))
        line = owner < self.num_segments
        distance[line] = segment_distance(places[line], self.segments[owner[line]])
        distance[~line] = triangle_distance(places[~line], self.triangles[owner[~line]])
        return distance


def _anchors_on_segments(segments: FloatArray, spacing: float) -> tuple[FloatArray, float, IntArray]:
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    step = max(spacing, float(length.sum()) / SCORES.max_anchors)
    count = np.maximum(np.ceil(length / step), 1).astype(np.int64)
    anchors, owner = places_on(segments, count)
    return anchors, float((length / count).max() / 2) if len(segments) else 0.0, owner


def _anchors_on_triangles(triangles: FloatArray, spacing: float) -> tuple[FloatArray, float, IntArray]:
    """Return the centres of n x n equal parts of each triangle; each is near its centre."""
    if len(triangles) == 0:
        return np.zeros((0, 3)), 0.0, np.zeros(0, np.int64)
    edges = triangles - np.roll(triangles, 1, axis=1)
    longest = np.linalg.norm(edges, axis=2).max(1)
    step = max(spacing, float(np.sqrt((longest**2).sum() / SCORES.max_anchors)))
    count = np.maximum(np.ceil(longest / step), 1).astype(np.int64)
    anchors, owners = [], []
    for n in np.unique(count).tolist():
        rows = np.flatnonzero(count == n)
        i, j = np.divmod(np.arange(n * n), n)
        upright = i + j < n  # the others are the parts that stand on their head
        a = np.where(upright, i + 1 / 3, n - i - 1 / 3) / n
        b = np.where(upright, j + 1 / 3, n - j - 1 / 3) / n
        weights = np.column_stack([1 - a - b, a, b])
        anchors.append(np.einsum("nk,tkx->tnx", weights, triangles[rows]).reshape(-1, 3))
        owners.append(np.repeat(rows, n * n))
    return np.concatenate(anchors), float((longest / count).max()) * 2 / 3, np.concatenate(owners)


def segment_distance(places: FloatArray, segments: FloatArray) -> FloatArray:
    """Return the distance (n,) of each place (n, 3) from its segment (n, 2, 3), which may be a point."""
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    square = np.einsum("ij,ij->i", along, along)
    share = np.einsum("ij,ij->i", places - start, along) / np.where(square > 0, square, 1)
    return np.linalg.norm(places - start - np.clip(share, 0, 1)[:, None] * along, axis=1)


def triangle_distance(places: FloatArray, triangles: FloatArray) -> FloatArray:
    """Return the distance (n,) of each place (n, 3) from its triangle (n, 3, 3), which may be degenerate."""
    result = np.full(len(places), np.inf)
    inside = np.ones(len(places), bool)
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    size = np.linalg.norm(normal, axis=1)
    for k in range(3):
        edge = triangles[:, [k, (k + 1) % 3]]
        result = np.minimum(result, segment_distance(places, edge))
        outward = np.cross(edge[:, 1] - edge[:, 0], normal)
        inside &= np.einsum("ij,ij->i", places - edge[:, 0], outward) <= 0
    inside &= size > 0
    height = np.abs(np.einsum("ij,ij->i", places - triangles[:, 0], normal)) / np.where(size > 0, size, 1)
    return np.where(inside, height, result)
