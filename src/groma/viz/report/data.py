# SPDX-License-Identifier: BSD-3-Clause
"""Data of the 3D view of the page, as text: arrays less a common offset, and the initial viewpoint."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.io.drawn import direction_of_lines
from groma.scene import Scene
from groma.scene.line_intervals import line_pieces
from groma.scene.patches import PALETTE, patch_area, patch_groups
from groma.scene.table import new_index_of
from groma.viz import colours as _colours
from groma.viz.drawable import Drawable, junctions
from groma.viz.framing import starting_view
from groma.viz.pack import pack, pack_bytes, pack_whole
from groma.viz.report.covariances import LandmarkCovariances
from groma.viz.report.kept import Kept
from groma.viz.statistics import LineStatistics, images_of, line_statistics


def scene_data(
    scenes: Sequence[Scene], states: Sequence[Drawable], kept: Kept, covariances: LandmarkCovariances | None = None
) -> dict[str, Any]:
    """Return the states of a scene for the 3D view; the last one is the current one."""
    scene, after = scenes[-1], states[-1]
    offset = _middle(after)
    meeting = kept.meeting(scene)
    owner = line_pieces(scene)[1]
    drawn = np.flatnonzero(new_index_of(kept.lines, scene.num_lines)[owner] >= 0)
    numbers = [line_statistics(one, shown) for one, shown in zip(scenes, states, strict=True)]
    point_errors = [shown.point_errors[kept.points] for shown in states]
    line_errors = [found.residual_px[kept.lines] for found in numbers]
    view = starting_view(after, offset)
    return {
        "states": [
            {
                "points": pack(shown.points[kept.points] - offset),
                "errors": pack(errors) if np.isfinite(errors).any() else "",
                "lines": pack(line_pieces(scene, shown.segments)[0][drawn] - offset),
                "line_errors": pack(far),
                "planes": pack(np.concatenate([*_patches_of(one, after), np.zeros((0, 3))]) - offset),
                "junctions": pack(junctions(shown.segments, meeting) - offset),
                "cameras": pack(_camera_axes(shown, offset)),
            }
            for one, shown, errors, far in zip(scenes, states, point_errors, line_errors, strict=True)
        ],
        "offset": offset.tolist(),
        "pieces": pack_whole(new_index_of(kept.lines, scene.num_lines)[owner[drawn]]),
        "points": _points(scene, after, kept),
        "lines": _lines(scene, numbers[-1], kept),
        "planes": _planes(scene, after),
        "directions": {"ids": pack_whole(scene.directions.ids)},
        "cameras": _cameras(scene),
        "relations": _relations(scene, kept),
        "junctions": pack_whole(new_index_of(kept.lines, scene.num_lines)[meeting]),
        "covariances": None if covariances is None else _covariances(covariances, kept, offset),
        "view": {
            "pivot": (view.pivot - offset).tolist(),
            "up": view.up.tolist(),
            "azimuth": view.azimuth,
            "elevation": view.elevation,
            "distance": view.distance,
            "camera_size": view.camera_size,
            "error_top": _top(point_errors[-1]),
            "line_error_top": _top(line_errors[-1]),
        },
    }


# --------------------------------------------------------------------------------------------------- Kinds of things


def _points(scene: Scene, after: Drawable, kept: Kept) -> dict[str, Any]:
    seen = scene.point_observations
    return {
        "ids": pack_whole(scene.points.ids[kept.points]),
        "images": pack_whole(images_of(seen.point_idx, seen.image_idx, scene.num_points)[kept.points]),
        "colours": pack_bytes(after.colours[kept.points]) if after.colours is not None else "",
    }


def _lines(scene: Scene, numbers: LineStatistics, kept: Kept) -> dict[str, Any]:
    direction = direction_of_lines(scene)
    shared = pack_bytes(_colours.of_shared_directions(scene)[kept.lines]) if (direction >= 0).any() else ""
    return {
        "ids": pack_whole(scene.lines.ids[kept.lines]),
        "images": pack_whole(numbers.num_images[kept.lines]),
        "lengths": pack(numbers.length[kept.lines]),
        "confidence": pack(scene.lines.confidence[kept.lines]),
        "direction": pack_whole(direction[kept.lines]),
        "colours": pack_bytes(_colours.of_lines(scene)[kept.lines]),
        "shared_colours": shared,
    }


def _planes(scene: Scene, after: Drawable) -> dict[str, Any]:
    return {
        "ids": pack_whole(scene.planes.ids),
        "corners": [len(patch) for patch in after.patches],
        "colours": [_colours.css(PALETTE[group]) for group in patch_groups(after.patch_members)],
        "areas": [patch_area(patch) for patch in after.patches],
    }


def _cameras(scene: Scene) -> dict[str, Any]:
    """Return the names and aspect ratios of all images."""
    camera = scene.images.camera_idx
    width, height = (np.asarray(side, float)[camera] for side in (scene.cameras.width, scene.cameras.height))
    aspect = np.divide(width, height, out=np.full(len(camera), 4.0 / 3.0), where=height > 0)
    return {"names": list(scene.images.names), "aspects": pack(aspect)}


def _relations(scene: Scene, kept: Kept) -> dict[str, str]:
    """Return relations as pairs of indices into the kept landmarks."""
    point, line = new_index_of(kept.points, scene.num_points), new_index_of(kept.lines, scene.num_lines)
    plane = np.arange(scene.num_planes)
    ends = {"line_on_plane": (line, plane), "point_on_plane": (point, plane), "point_on_line": (point, line)}

    def packed(pairs: IntArray, first: IntArray, second: IntArray) -> str:
        found = np.column_stack([first[pairs[:, 0]], second[pairs[:, 1]]])
        return pack_whole(found[(found >= 0).all(axis=1)])

    return {name: packed(getattr(scene.relations, name), *sides) for name, sides in ends.items()}


def _covariances(found: LandmarkCovariances, kept: Kept, offset: FloatArray) -> dict[str, Any]:
    """Return upper triangles of the covariances of coordinates less the offset."""
    local = found.moved(offset)
    return {
        "gauge": found.gauge,
        "points": _triangles(local.points[kept.points]),
        "lines": _triangles(local.lines[kept.lines]),
        "planes": _triangles(local.planes),
        "centers": _triangles(local.centers),
    }


def _triangles(matrices: FloatArray) -> str:
    """Return the upper triangles of symmetric matrices; rows of -1 for unknown ones."""
    rows = matrices[:, *np.triu_indices(matrices.shape[-1])]
    return pack(np.where(np.isfinite(rows).all(axis=1, keepdims=True), rows, -1.0))


# ------------------------------------------------------------------------------------------------------------- Parts


def _top(errors: FloatArray) -> float:
    """Return the error at the end of the colour ramp: the 95th percentile."""
    known = errors[np.isfinite(errors) & (errors > 0)]
    return float(np.percentile(known, 95)) if len(known) else 1.0


def _patches_of(scene: Scene, after: Drawable) -> list[FloatArray]:
    """Return the patches of the last state, projected onto the planes of this one."""
    return [
        patch - (patch @ plane[:3] + plane[3])[:, None] * plane[:3]
        for patch, plane in zip(after.patches, scene.planes.hesse, strict=True)
    ]


def _middle(scene: Drawable) -> FloatArray:
    places = np.concatenate([scene.points, scene.segments.reshape(-1, 3), scene.centers])
    places = places[np.isfinite(places).all(axis=1)]
    return np.asarray(np.median(places, axis=0), np.float64) if len(places) else np.zeros(3)


def _camera_axes(scene: Drawable, offset: FloatArray) -> FloatArray:
    return np.concatenate([(scene.centers - offset)[:, None], scene.world_from_cam_axes], axis=1).reshape(-1, 12)
