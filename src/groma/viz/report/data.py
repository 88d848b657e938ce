# SPDX-License-Identifier: BSD-3-Clause
"""What the 3D view of the page draws, as text: arrays in single precision less a common offset, and where to start."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from groma._typing import FloatArray
from groma.scene.line_intervals import line_pieces
from groma.scene.patches import PALETTE, patch_groups
from groma.viz import colours as _colours
from groma.viz.framing import starting_view
from groma.viz.pack import pack, pack_bytes, thin
from groma.viz.statistics import line_statistics

if TYPE_CHECKING:
    from groma.scene import Scene
    from groma.viz.drawable import Drawable

#: More points, and more lines, than this are thinned out evenly: a page should open in a second.
MAX_POINTS = 200_000
MAX_LINES = 40_000


def scene_data(scenes: Sequence[Scene], states: Sequence[Drawable]) -> dict[str, Any]:
    """Return the states of a scene for the 3D view, the last one being the one that counts."""
    scene, after = scenes[-1], states[-1]
    offset = _middle(after)
    owner = line_pieces(scene)[1]
    keep, drawn = thin(len(after.points), MAX_POINTS), thin(len(owner), MAX_LINES)
    lines = owner[drawn]
    view = starting_view(after, offset)
    numbers = [line_statistics(one, shown) for one, shown in zip(scenes, states, strict=True)]
    point_errors = [shown.point_errors[keep] for shown in states]
    line_errors = [found.residual_px[lines] for found in numbers]
    return {
        "states": [
            {
                "points": pack(shown.points[keep] - offset),
                "errors": pack(errors) if np.isfinite(errors).any() else "",
                "lines": pack(line_pieces(scene, shown.segments)[0][drawn] - offset),
                "line_errors": pack(far),
                "planes": pack(np.concatenate([*_patches_of(one, after), np.zeros((0, 3))]) - offset),
                "cameras": pack(_camera_axes(shown, offset)),
            }
            for one, shown, errors, far in zip(scenes, states, point_errors, line_errors, strict=True)
        ],
        "colours": pack_bytes(after.colours[keep]) if after.colours is not None else "",
        "line_colours": pack_bytes(_colours.of_lines(scene)[lines]),
        "shared_directions": bool(len(scene.relations.line_along_direction)),
        "line_views": pack(numbers[-1].num_images[lines].astype(float)),
        "corners": [len(patch) for patch in after.patches],
        "plane_colours": [_colours.css(PALETTE[group]) for group in patch_groups(after.patch_members)],
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


def _top(errors: FloatArray) -> float:
    """Return the error that gets the last colour: what 95 of 100 stay below."""
    known = errors[np.isfinite(errors) & (errors > 0)]
    return float(np.percentile(known, 95)) if len(known) else 1.0


def _patches_of(scene: Scene, after: Drawable) -> list[FloatArray]:
    """Return the pieces of planes of the last state, on the planes of this one."""
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
