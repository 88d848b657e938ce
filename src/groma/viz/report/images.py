# SPDX-License-Identifier: BSD-3-Clause
"""Overlays of the photographs: residuals of points, measured segments, images of 3D segments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from groma import cameras
from groma._counted import natural_key
from groma._typing import FloatArray, IntArray
from groma.execution import begin
from groma.scene import Scene
from groma.scene.line_intervals import one_line_per_interval
from groma.scene.local_frame import up_of
from groma.scene.table import new_index_of
from groma.viz.drawable import Drawable
from groma.viz.pack import pack, pack_whole, thin
from groma.viz.pictures import ImageFiles, image_file, jpeg_address, read_picture, turns_of, warn_of_names_outside
from groma.viz.report.kept import Kept
from groma.viz.report.overlays import projected_places

#: Maximum number of photographs, their longer side in pixels, and their total size in characters.
MAX_PHOTOS = 60
PHOTO_SIZE = 1100
PHOTO_BUDGET = 9_000_000
#: Places along the image of a segment that lens distortion bends.
_SAMPLES = 6


@dataclass(frozen=True)
class Photographs:
    """Photographs of a page that are being read, in the order of the images with observations."""

    #: Returns their data URLs; empty where there is none.
    addresses: Callable[[], list[str]]
    #: Quarter turns to the right that show each upright.
    turns: list[int]


def page_photographs(scene: Scene, images: ImageFiles | None) -> Photographs:
    """Start to read the photographs of a page, at a size that depends on their number.

    They depend only on which images have observations, so they can be read before the page is written.
    """
    return _photographs([scene.images.names[image] for image in _used(scene)], images)


def _photographs(names: Sequence[str], images: ImageFiles | None) -> Photographs:
    warn_of_names_outside(images, names)
    files = {place: path for place, name in enumerate(names) if (path := image_file(images, name)) is not None}
    chosen = np.array(list(files))[thin(len(files), MAX_PHOTOS)].tolist() if files else []
    budget = PHOTO_BUDGET // max(len(chosen), 1)
    begun = {place: begin(partial(_photograph, files[place], budget)) for place in chosen}
    turns = turns_of(images, names).tolist()
    return Photographs(lambda: [begun[place]() if place in begun else "" for place in range(len(names))], turns)


def up_in_page(scene: Scene, photographs: Photographs) -> FloatArray:
    """Return the direction (3,) that is up, the photographs shown upright."""
    turns = np.zeros(scene.num_images, np.int64)
    turns[_used(scene)] = photographs.turns
    return up_of(scene, turns)


def _photograph(file: Path, budget: int) -> str:
    picture = read_picture(file, PHOTO_SIZE)
    return "" if picture is None else jpeg_address(picture, budget)


def _used(scene: Scene) -> IntArray:
    """Return the images with observations, sorted by name."""
    seen = scene.point_observations.image_idx, scene.line_observations.image_idx
    used = np.flatnonzero(sum(np.bincount(one, minlength=scene.num_images) for one in seen))
    return np.array(sorted(used.tolist(), key=lambda image: natural_key(scene.images.names[image])), np.int64)


def image_data(scene: Scene, kept: Kept, states: Sequence[Drawable], photographs: Photographs) -> dict[str, Any]:
    """Return an entry per image with observations, and the rows that the entries refer to.

    ``first`` is the initial entry. ``rows`` are points: measured place, then the residual in each state.
    ``segments`` are 2D segments: measured ends, then the vectors from them to the image of their line in each state;
    ``row_points`` and ``segment_lines`` are indices of their landmarks among the kept ones; ``projected`` are the
    images of the 3D segments in the last state, ``samples`` places each, zero where there is none.
    """
    after = states[-1]
    num_points = len(scene.point_observations)
    seen, pieces = scene.line_observations, one_line_per_interval(scene)
    point_rows = _by_image(kept.point_observations, scene.point_observations.image_idx, scene.num_images)
    segment_rows = _by_image(kept.line_observations, seen.image_idx, scene.num_images)
    samples = 2 if all(cameras.model(name).has_pinhole_parameters for name in scene.cameras.models) else _SAMPLES
    points_seen = np.bincount(scene.point_observations.image_idx, minlength=scene.num_images)
    lines_seen = np.bincount(seen.image_idx, minlength=scene.num_images)
    used = _used(scene)
    ends = np.cumsum([[len(point_rows[image]), len(segment_rows[image])] for image in [*used]] or [[0, 0]], axis=0)
    begins = np.vstack([[0, 0], ends[:-1]])
    rows, segments = (
        np.concatenate([*(groups[image] for image in used), np.zeros(0, np.int64)]).astype(np.int64)
        for groups in (point_rows, segment_rows)
    )
    projected = [
        _projected(pieces, image, pieces.line_observations.line_idx[segment_rows[image]], samples)
        for image in used.tolist()
    ]
    ways = [state.residuals[num_points:].reshape(-1, 4)[segments] for state in states]
    point_ways = [state.residuals[:num_points][rows] for state in states]
    entries, photos = [], photographs.addresses()
    for place, image in enumerate(used.tolist()):
        left, top, width, height = _frame(after, image)
        entries.append(
            {
                "name": scene.images.names[image],
                "camera": image,
                "rows": [int(begins[place, 0]), int(ends[place, 0])],
                "segments": [int(begins[place, 1]), int(ends[place, 1])],
                "points_seen": int(points_seen[image]),
                "lines_seen": int(lines_seen[image]),
                "frame": [left, top, width, height],
                "turn": photographs.turns[place],
                "median": [float(state.median_by_image[image]) for state in states],
                "photo": photos[place] if left == top == 0.0 else "",
            }
        )
    return {
        "images": entries,
        "first": _first(entries),
        "rows": pack(np.concatenate([after.residual_place[:num_points][rows], *point_ways], axis=1)),
        "row_points": pack_whole(new_index_of(kept.points, scene.num_points)[scene.point_observations.point_idx[rows]]),
        "segments": pack(np.concatenate([seen.segment[segments], *ways], axis=1)),
        "segment_lines": pack_whole(new_index_of(kept.lines, scene.num_lines)[seen.line_idx[segments]]),
        "projected": pack(np.concatenate([*projected, np.zeros((0, 2 * samples))])),
        "samples": samples,
    }


def _first(entries: Sequence[dict[str, Any]]) -> int:
    """Return the initial image: with a photograph if any, then with most lines, then with most points."""
    keys = [(bool(entry["photo"]), entry["lines_seen"], entry["points_seen"]) for entry in entries]
    return keys.index(max(keys)) if keys else 0


def _by_image(rows: IntArray, image_idx: IntArray, num_images: int) -> list[IntArray]:
    """Group observations by image."""
    order = rows[np.argsort(image_idx[rows], kind="stable")]
    bounds = np.searchsorted(image_idx[order], np.arange(num_images + 1))
    return [order[first:last].astype(np.int64) for first, last in pairwise(bounds)]


def _projected(scene: Scene, image: int, lines: IntArray, samples: int) -> FloatArray:
    """Return the images of 3D segments (n, 2 * samples); zeros behind the camera."""
    found = np.zeros((len(lines), samples, 2))
    places, seen = projected_places(scene, image, lines) if len(lines) else (found, np.ones((0, samples), bool))
    rest = seen.sum(axis=1) >= 2
    if places.shape[1] == samples:
        whole = seen.all(axis=1)
        found[whole], rest = places[whole], rest & ~whole
    for row in np.flatnonzero(rest).tolist():
        way = places[row, seen[row]]
        at = np.linspace(0.0, len(way) - 1.0, samples)
        found[row] = np.stack([np.interp(at, np.arange(len(way)), way[:, axis]) for axis in (0, 1)], axis=1)
    width, height = scene.cameras.width, scene.cameras.height
    size = float(max(width.max(initial=0), height.max(initial=0))) or np.inf
    # Far outside, models of distortion are not meant to be used.
    found[(np.abs(found) > 3.0 * size).any(axis=(1, 2)) if samples > 2 else np.zeros(len(found), bool)] = 0.0
    return found.reshape(-1, 2 * samples)


def _frame(scene: Drawable, index: int) -> tuple[float, float, float, float]:
    """Return left, top, width, height of the image, or of its measurements if the size is unknown."""
    width, height = scene.image_sizes[index]
    if width > 0 and height > 0:
        return 0.0, 0.0, float(width), float(height)
    mine = scene.residual_place[scene.residual_image == index]
    low, high = mine.min(axis=0), mine.max(axis=0)
    margin = 0.03 * max(float((high - low).max()), 1.0)
    left, top = low - margin
    width, height = np.maximum(high - low, 1.0) + 2 * margin
    return float(left), float(top), float(width), float(height)
