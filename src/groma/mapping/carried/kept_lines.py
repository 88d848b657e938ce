# SPDX-License-Identifier: BSD-3-Clause
"""Lines of the maps that a map was made of, which it did not find anew: they are kept, as their images show them.

A map of ``groma track`` has lines that photographs alone do not determine, because depth was measured too. Such a line
goes along with the images that see it: it stays where it was in their cameras, in the mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.evaluation.alignment import align_poses
from groma.geometry import quaternion
from groma.geometry.segment2 import segments_apart
from groma.scene import LineObservations, Scene, Similarity
from groma.scene.landmarks import Lines
from groma.scene.table import joined, moved_table


def with_lines_of(
    scene: Scene, maps: Sequence[Scene], names: Sequence[Sequence[str]], same: IntArray, near: float
) -> Scene:
    """Return a joint map with the lines of two maps that it has not.

    Parameters
    ----------
    scene
        The joint map.
    maps, names
        The first and the second map, and what their images are called in the joint one.
    same
        (n, 2) lines of the second map and of the first that are the same: they become one.
    near
        Segments of an image whose ends are as near to each other's lines, pixels, are of one line.
    """
    # Rows of the joint table of lines, of the lines of the first map.
    out, of_first = scene, np.full(maps[0].num_lines, -1)
    for number, (one, called) in enumerate(zip(maps, names, strict=True)):
        taken = np.full(one.num_lines, -1)
        if number:
            taken[same[:, 0]] = of_first[same[:, 1]]
        out, rows = _with_lines(out, scene, one, called, taken, near)
        of_first = of_first if number else rows
    return out


def _with_lines(
    out: Scene, scene: Scene, one: Scene, called: Sequence[str], taken: IntArray, near: float
) -> tuple[Scene, IntArray]:
    """Add lines of one map; ``taken`` are rows of lines that are there already. Also returns the row of each, or -1."""
    place = {name: row for row, name in enumerate(scene.images.names)}
    image = np.array([place.get(name, -1) for name in called], np.int64)
    both, chosen = np.flatnonzero(image >= 0), np.flatnonzero(image[one.line_observations.image_idx] >= 0)
    seen = one.line_observations.take(chosen)
    if len(both) < 2 or not len(seen):
        return out, taken
    scale = align_poses(one.cam_from_world[both], scene.cam_from_world[image[both]]).scale
    count = np.bincount(seen.line_idx, minlength=one.num_lines)
    found = np.bincount(seen.line_idx, _is_there(scene.line_observations, seen, image, near), one.num_lines)
    fresh = np.flatnonzero((count > 0) & (2 * found < count) & (taken < 0))
    row = taken.copy()
    row[fresh] = out.num_lines + np.arange(len(fresh))
    ends = _moved(scene, one, seen, image, scale)[fresh]
    ids = out.lines.ids.max(initial=0) + 1 + np.arange(len(fresh))
    lines = replace(Lines.through(ends, ids), confidence=one.lines.confidence[fresh])
    used = np.flatnonzero(row[seen.line_idx] >= 0)
    added = seen.take(used)
    added = added.replace(image_idx=image[added.image_idx], line_idx=row[added.line_idx])
    observation = np.full(one.num_line_observations, -1)
    observation[chosen[used]] = out.num_line_observations + np.arange(len(used))
    moved = Similarity(1.0 if one.has_scale and scene.has_scale else scale)
    depths = moved_table(one.line_depths, moved).renumbered({"line_observations": observation})[0]
    return out.replace(
        lines=joined(out.lines, lines),
        line_observations=joined(out.line_observations, added),
        line_depths=joined(out.line_depths, depths),
    ), row


def _moved(scene: Scene, one: Scene, seen: LineObservations, image: IntArray, scale: float) -> FloatArray:
    """Ends (L, 2, 3) of the lines of a map in the joint world, in the mean over the images that see them."""
    then, now = one.cam_from_world[seen.image_idx], scene.cam_from_world[image[seen.image_idx]]
    inside = np.einsum("nij,nkj->nki", quaternion.to_matrix(then[:, :4]), one.lines.segments[seen.line_idx])
    inside = scale * (inside + then[:, None, 4:]) - now[:, None, 4:]
    ends = np.einsum("nji,nkj->nki", quaternion.to_matrix(now[:, :4]), inside)
    total, count = np.zeros((one.num_lines, 2, 3)), np.bincount(seen.line_idx, minlength=one.num_lines)
    np.add.at(total, seen.line_idx, ends)
    return total / np.maximum(count, 1)[:, None, None]


def _is_there(table: LineObservations, seen: LineObservations, image: IntArray, near: float) -> BoolArray:
    """Which segments (n,) show a line that the joint map observes in the same image."""
    there = np.zeros(len(seen), bool)
    for number in np.unique(image[image >= 0]).tolist():
        rows = np.flatnonzero(image[seen.image_idx] == number)
        theirs = table.segment[table.image_idx == number]
        if len(rows) and len(theirs):
            there[rows] = (segments_apart(seen.segment[rows], theirs) < near).any(axis=1)
    return there
