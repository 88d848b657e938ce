# SPDX-License-Identifier: BSD-3-Clause
"""Where along a line images support it: the intervals of its segment that were seen, one landmark for all of them.

The joints left and right of a window may lie on one line, and bind as one in the adjustment, but between them there is
nothing. A line of a scene therefore has the hull of what was seen, ``Lines.segments``, and, where that has gaps, rows
here. What draws, writes or compares lines takes :func:`line_pieces`; what knows only segments with tracks of their own
takes the scene of :func:`one_line_per_interval`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError
from groma.geometry import quaternion
from groma.geometry.algebra import dot, ratio
from groma.geometry.incidence import MIN_SINE
from groma.scene.landmarks import Lines
from groma.scene.table import Table, column

if TYPE_CHECKING:
    from groma.scene.scene import Scene

#: A ray whose angle with a line has a smaller sine (squared) does not determine its nearest place on the line.
MIN_SQUARED_SINE = MIN_SINE**2


@dataclass(frozen=True, eq=False)
class LineIntervals(Table, noun="interval", optional=True):
    """Parts of lines that images support. A line without rows is supported from end to end."""

    #: (K,) the line.
    line_idx: IntArray = column(np.int64, refers="lines")
    #: (K,) bounds of the interval on its segment: 0 is the first end point, 1 the second.
    begin: FloatArray = column(np.float64)
    end: FloatArray = column(np.float64)

    def _check(self) -> None:
        wrong = ~((self.begin >= 0.0) & (self.begin < self.end) & (self.end <= 1.0))
        if wrong.any():
            row = int(wrong.argmax())
            raise InputError(
                f"LineIntervals must begin before they end, both between 0 and 1; row {row} is from {self.begin[row]} "
                f"to {self.end[row]}. Leave it out."
            )

    def of_lines(self, num_lines: int) -> tuple[IntArray, FloatArray]:
        """Return line (K,) and shares (K, 2) of the intervals of all lines, in order; (0, 1) for lines without rows."""
        whole = np.flatnonzero(np.bincount(self.line_idx, minlength=num_lines) == 0)
        line = np.concatenate([self.line_idx, whole])
        share = np.concatenate([np.column_stack([self.begin, self.end]), np.tile([0.0, 1.0], (len(whole), 1))])
        order = np.lexsort((share[:, 0], line))
        return line[order], share[order]

    def covers(self, line_idx: IntArray, share: FloatArray, margin: float = 0.0) -> BoolArray:
        """Return which places (N,) on lines, as shares, lie in an interval extended by a multiple of its length."""
        count = int(line_idx.max(initial=-1)) + 1
        kept = self.take(self.line_idx < count)
        line, interval = kept.of_lines(count)
        row, piece = _candidates(line_idx, np.searchsorted(line, np.arange(count + 1)))
        slack = margin * (interval[:, 1] - interval[:, 0])
        inside = (share[row] > (interval[:, 0] - slack)[piece]) & (share[row] < (interval[:, 1] + slack)[piece])
        return np.bincount(row, inside, minlength=len(line_idx)) > 0


def line_pieces(scene: Scene, segments: FloatArray | None = None) -> tuple[FloatArray, IntArray]:
    """Return the supported segments of all lines (K, 2, 3), and the line (K,) of each.

    Parameters
    ----------
    scene : Scene
        Lines and their intervals.
    segments : (L, 2, 3) float, optional
        The same lines at other places.
    """
    line, share = scene.line_intervals.of_lines(scene.num_lines)
    hull = (scene.lines.segments if segments is None else segments)[line]
    along = hull[:, 1] - hull[:, 0]
    pieces = hull[:, :1] + share[..., None] * along[:, None]
    return np.where((share == [0.0, 1.0])[..., None], hull, pieces), line


def supported_lengths(scene: Scene) -> FloatArray:
    """Lengths (L,) of what images support of each line, scene units."""
    pieces, line = line_pieces(scene)
    length = np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1)
    return np.asarray(np.bincount(line, length, scene.num_lines), np.float64)


def shares_on_lines(
    scene: Scene,
    image_idx: IntArray,
    pixels: FloatArray,
    segments: FloatArray,
    min_squared_sine: float = MIN_SQUARED_SINE,
) -> FloatArray:
    """Return where on segments (N, 2, 3) the points nearest to the rays of pixels (N, 2) lie, (N,).

    0 is the first end of a segment, 1 the second. NaN where the camera has no ray, or the ray runs along the line.
    """
    poses = scene.cam_from_world[image_idx]
    bearing = np.full((len(pixels), 3), np.nan)
    for model, rows, params in scene.cameras.rows_by_model(scene.images.camera_idx[image_idx]):
        bearing[rows] = model.unproject(params, np.ascontiguousarray(pixels[rows]))
    ray = quaternion.rotate(quaternion.conjugate(poses[:, :4]), bearing)
    center = -quaternion.rotate(quaternion.conjugate(poses[:, :4]), poses[:, 4:])
    along = segments[:, 1] - segments[:, 0]
    normal = np.cross(np.cross(along, ray), ray)
    slope, size = dot(normal, along), dot(along, along) * dot(ray, ray)
    return ratio(dot(normal, center - segments[:, 0]), slope, np.abs(slope) > min_squared_sine * size)


def observed_shares(scene: Scene) -> FloatArray:
    """Return from where to where on its line each observed segment reaches, (N, 2): shares, the smaller first."""
    seen = scene.line_observations
    ends = [
        shares_on_lines(scene, seen.image_idx, seen.segment[:, part], scene.lines.segments[seen.line_idx])
        for part in (slice(0, 2), slice(2, 4))
    ]
    return np.sort(np.column_stack(ends), axis=1)


def one_line_per_interval(scene: Scene) -> Scene:
    """Return the scene with every interval as a separate line, for formats of segments with tracks.

    The first interval keeps the identifier; further ones get new identifiers. An observed segment goes to the interval
    that it covers most of, points on the line to the nearest one, and every interval lies on all planes and along all
    directions of the line.
    """
    if len(scene.line_intervals) == 0:
        return scene
    pieces, line = line_pieces(scene)
    first = np.searchsorted(line, np.arange(scene.num_lines + 1))
    ids = scene.lines.ids[line].copy()
    further = np.arange(len(line)) != first[line]
    ids[further] = scene.lines.ids.max() + 1 + np.arange(further.sum())
    _, share = scene.line_intervals.of_lines(scene.num_lines)
    observed, of = observed_shares(scene), scene.line_observations.line_idx
    owner = _owners(of, first, lambda rows, piece: -_common(observed[rows], share[piece]))
    relations, columns = scene.relations, {}
    for kind in ("line_on_plane", "line_along_direction"):
        pairs = getattr(relations, kind)
        row, piece = _candidates(pairs[:, 0], first)
        columns |= {kind: np.column_stack([piece, pairs[row, 1]]), f"{kind}_sigma": relations.sigma(kind)[row]}
    point, on = relations.point_on_line.T
    start, along = scene.lines.segments[on, 0], scene.lines.segments[on, 1] - scene.lines.segments[on, 0]
    place = dot(scene.points.xyz[point] - start, along) / dot(along, along)
    nearest = _owners(on, first, lambda rows, piece: _beyond(place[rows], share[piece]))
    columns["point_on_line"] = np.column_stack([point, nearest])
    return scene.replace(
        lines=Lines(ids, scene.lines.plucker[line], pieces, scene.lines.confidence[line]),
        line_observations=scene.line_observations.replace(line_idx=owner),
        relations=replace(relations, **columns),
        line_intervals=LineIntervals(),
    )


def _candidates(line: IntArray, first: IntArray) -> tuple[IntArray, IntArray]:
    """Return all pairs of an item and a piece of its line; pieces of line n are ``first[n] : first[n + 1]``."""
    row = np.repeat(np.arange(len(line)), np.diff(first)[line])
    return row, first[line[row]] + np.arange(len(row)) - np.searchsorted(row, row)


def _owners(line: IntArray, first: IntArray, cost: Callable[[IntArray, IntArray], FloatArray]) -> IntArray:
    """Return, for items on lines (N,), the piece (N,) of least ``cost(rows, pieces)``; the first of several."""
    row, piece = _candidates(line, first)
    order = np.lexsort((cost(row, piece), row))
    return piece[order][np.searchsorted(row[order], np.arange(len(line)))]


def _common(one: FloatArray, other: FloatArray) -> FloatArray:
    """Lengths that intervals (N, 2) have in common; negative gaps where they have none, or where one is not known."""
    common = np.minimum(one[:, 1], other[:, 1]) - np.maximum(one[:, 0], other[:, 0])
    return np.where(np.isnan(common), -np.inf, common)


def _beyond(place: FloatArray, interval: FloatArray) -> FloatArray:
    """How far places (N,) lie outside of intervals (N, 2)."""
    return np.maximum(np.maximum(interval[:, 0] - place, place - interval[:, 1]), 0.0)
