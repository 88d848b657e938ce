# SPDX-License-Identifier: BSD-3-Clause
"""How much of what a pose says is in a photograph is there: part by part of the image, by points and lines of the map.

A photograph that is put together of pieces, or shows another place that has something in common with the map, agrees
with a pose in one part; elsewhere points and lines are to be seen by the map, and none is. Not all that could be seen
is found again in any photograph. How often, the map knows from its own images: of the points that images near one of
them see, and that its pose puts into it, it sees some itself, the more the more of the others do.

Where a place repeats, another that looks like it shows what repeats in every part. What only this place has is missing
there: points that tell it from others (:mod:`groma.localization.repeated`), found more like themselves than any other
place of the map is. They are to be found about as often as all, and count by themselves where several are in one part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._numba import loop
from groma._rows import distinct
from groma._typing import BoolArray, FloatArray, IntArray
from groma.localization.landmarks import counted_in
from groma.localization.map_index import MapIndex
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.gates import VERDICT
from groma.localization.pose.matches import Matches
from groma.localization.pose.refinement import Refined
from groma.localization.pose.verdict import Shown
from groma.localization.repeated import ALIKE
from groma.mapping.image_segments import is_used
from groma.scene import Scene

#: Images of a map that are asked how often points are found again, at most (cost: time).
_ASKED = 40
#: Pieces that lines are cut into, to tell the parts that they cross: one a part, where they cross the whole image.
_PIECES = VERDICT.parts


# ---------------------------------------------------------------------------------------------------------- Kernels
@loop
def _place(pixel, width, height, scale, parts, out):
    """The part that each pixel lies in, row by row; -1 outside the image."""
    for i in range(pixel.shape[0]):
        u, v = pixel[i, 0], pixel[i, 1]
        out[i] = -1
        if 0.0 <= u <= width and 0.0 <= v <= height:
            out[i] = min(int(v * scale), parts - 1) * parts + min(int(u * scale), parts - 1)


# ----------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True, eq=False)
class FoundAgain:
    """How often points of a map are found again, learned from its own images."""

    #: (2, N + 1) of points that repeat, and of unique ones, by the number of images near a photograph, of N, that see
    #: them.
    rate: FloatArray

    @staticmethod
    def of(scene: Scene, index: MapIndex, near: int) -> FoundAgain:
        """Ask some images of a map what they see of what so many others near them see."""
        count = len(index.image)
        seen = [distinct(index.point[index.begin[i] : index.begin[i + 1]], len(index.xyz))[0] for i in range(count)]
        total = np.bincount(np.concatenate([*seen, np.zeros(0, np.int64)]), minlength=len(index.xyz))
        asked, found = np.ones((2, near + 1)), np.zeros((2, near + 1))
        for image in np.unique(np.linspace(0, count - 1, min(count, _ASKED)).astype(int)).tolist():
            others = np.delete(np.arange(count), image)
            others = nearest_images(index, others, seen[image], near)
            itself = np.zeros(len(index.xyz), bool)
            itself[seen[image]] = True
            point, times = _seen_by(index, others)
            rows = total[point] - itself[point] >= 2  # points that are in the map without this image
            camera = QueryCamera.of(scene.cameras, int(scene.images.camera_idx[image]))
            rows[rows] = camera.inside(camera.project(scene.cam_from_world[image], index.xyz[point[rows]]))
            kind = (index.telling[point[rows]] >= ALIKE) * (near + 1) + times[rows]
            asked += np.bincount(kind, minlength=asked.size).reshape(asked.shape)
            found += np.bincount(kind, itself[point[rows]], asked.size).reshape(asked.shape)
        return FoundAgain(found / asked)


def nearest_images(index: MapIndex, images: IntArray, points: IntArray, count: int) -> IntArray:
    """Return those of some images of a map that see most of some points."""
    return images[np.argsort(-counted_in(index, images, points), kind="stable")[:count]]


def shown_of(
    scene: Scene,
    index: MapIndex,
    again: FoundAgain,
    near: IntArray,
    best: Refined,
    matches: Matches,
    found: tuple[IntArray, IntArray],
    lines: bool = True,
    used: BoolArray | None = None,
) -> Shown:
    """Return how much of what a pose puts into an image is there.

    Parts count by what is expected in them, points and lines alike.

    Parameters
    ----------
    scene, index, again
        The map.
    near
        Its images near the photograph: what they see is expected.
    best, matches, found
        The pose, what was looked for under it, and the points of the index that agree and are described alike; and
        those that are described more alike than any other place.
    lines
        Whether lines were looked for.
    used
        (H, W) where anything was looked for; None: everywhere.
    """
    camera, side = best.camera, max(best.camera.width, best.camera.height) / VERDICT.parts
    ends = matches.segments2d[best.line_inliers]
    shown = np.concatenate([matches.points2d[best.point_inliers], _middles(_borders(ends)).reshape(-1, 2)])
    point, times = _seen_by(index, near)
    pixel = camera.project(best.pose, index.xyz[point])
    inside = camera.inside(pixel)
    if used is not None:
        inside[inside] = is_used(used, pixel[inside])
    point, pixel, telling = point[inside], pixel[inside], index.telling[point[inside]]
    rate = again.rate[(telling >= ALIKE).astype(np.int64), times[inside]]
    expected = [(pixel, rate, VERDICT.expected)]
    if lines and scene.num_lines:
        rows = np.concatenate([np.arange(int(index.segment_begin[i]), int(index.segment_begin[i + 1])) for i in near])
        known = distinct(scene.line_observations.line_idx[index.segment[rows]], scene.num_lines)[0]
        middle, length = _lengths(camera, best.pose, scene.lines.segments[known])
        if used is not None:
            length = np.where(is_used(used, np.nan_to_num(middle)), length, 0.0)
        expected.append((middle, length, 0.5 * side))
    parts = _counted(camera, expected, shown, VERDICT.parts)
    alike, itself = (np.isin(point, some) for some in found)
    often = min(1.0, float(alike.sum()) / max(float(rate.sum()), 1e-12))
    told, part = itself & (telling > 0.0), _part(pixel, camera, VERDICT.parts)
    together = np.bincount(part, often * rate * telling, VERDICT.parts**2)
    some = together >= VERDICT.expected
    count = int(told[~some[part]].sum()), int(told[some[part]].sum())
    return Shown(*parts, count, (float(together[~some].sum()), float(together[some].sum())))


def _counted(
    camera: QueryCamera, expected: list[tuple[FloatArray, FloatArray, float]], shown: FloatArray, parts: int
) -> tuple[float, float]:
    """Parts that show something and parts that do not; ``expected`` are places, weights, and how much makes a part."""
    every = parts * parts
    weight, counts = np.zeros(every), np.zeros(every, bool)
    for pixel, amount, least in expected:
        part = _part(pixel, camera, parts)
        total = np.bincount(part[part >= 0], amount[part >= 0], every)
        weight += total / max(float(total.sum()), 1e-12)
        counts |= total >= least
    seen = np.zeros(every, bool)
    part = _part(shown, camera, parts)
    seen[part[part >= 0]] = True
    if not counts.any():
        return 0.0, 0.0
    missing = float(weight[counts & ~seen].sum() / weight[counts].sum() * counts.sum())
    return float(counts.sum()) - missing, missing


def _part(pixel: FloatArray, camera: QueryCamera, parts: int) -> IntArray:
    """The part of an image that each pixel lies in, of so many per longer side; -1 outside."""
    part = np.empty(len(pixel), np.int64)
    scale = parts / max(camera.width, camera.height)
    _place(np.ascontiguousarray(pixel), camera.width, camera.height, scale, parts, part)
    return part


def _seen_by(index: MapIndex, images: IntArray) -> tuple[IntArray, IntArray]:
    """Points of a map that some images see, and how many of them do."""
    times = np.zeros(len(index.xyz), np.int64)
    for image in images.tolist():
        seen = np.zeros(len(index.xyz), bool)
        seen[index.point[index.begin[image] : index.begin[image + 1]]] = True
        times += seen
    point = np.flatnonzero(times)
    return point, times[point]


def _borders(ends: FloatArray) -> FloatArray:
    """Where the pieces of segments (n, 2, k) begin and end, (n, pieces + 1, k)."""
    share = np.linspace(0.0, 1.0, _PIECES + 1)[None, :, None]
    return ends[:, :1] + share * (ends[:, 1:] - ends[:, :1])


def _middles(borders: FloatArray) -> FloatArray:
    return 0.5 * (borders[:, 1:] + borders[:, :-1])


def _lengths(camera: QueryCamera, pose: FloatArray, ends: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Middles (n, 2) of the images of pieces of 3D segments, and the lengths (n,) of these images."""
    borders = _borders(ends)
    pixel = camera.project(pose, borders.reshape(-1, 3)).reshape(*borders.shape[:2], 2)
    length = np.linalg.norm(pixel[:, 1:] - pixel[:, :-1], axis=2).ravel()
    return _middles(pixel).reshape(-1, 2), np.nan_to_num(length)
