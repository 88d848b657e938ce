# SPDX-License-Identifier: BSD-3-Clause
"""Landmarks that nothing holds: points and lines that no image sees, planes and directions without enough on them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields

import numpy as np

from groma._typing import IntArray
from groma.scene import Relations, Scene

#: Points, a line counting twice, that fix a plane; lines that make a direction a common one.
_FEWEST_ON_PLANE, _FEWEST_ALONG = 3, 2


def without_unused(scene: Scene, *others: Scene) -> tuple[Scene, ...]:
    """Return a scene without the landmarks that nothing holds, and others with the same landmarks without them too.

    Numbers in files (ids) stay those of the landmarks; only positions in the arrays change.
    """
    seen = {
        "point": np.bincount(scene.point_observations.point_idx, minlength=scene.num_points) > 0,
        "line": np.bincount(scene.line_observations.line_idx, minlength=scene.num_lines) > 0,
    }
    on = {
        name: pairs[seen[name.split("_")[0]][pairs[:, 0]], 1]
        for name in ("point_on_plane", "line_on_plane", "line_along_direction")
        for pairs in [getattr(scene.relations, name)]
    }
    on_plane = np.bincount(on["point_on_plane"], minlength=scene.num_planes)
    on_plane += 2 * np.bincount(on["line_on_plane"], minlength=scene.num_planes)
    along = np.bincount(on["line_along_direction"], minlength=scene.num_directions)
    kept = seen | {"plane": on_plane >= _FEWEST_ON_PLANE, "direction": along >= _FEWEST_ALONG}
    rows = {name: np.flatnonzero(mask) for name, mask in kept.items()}
    new = {name: np.where(mask, np.cumsum(mask) - 1, -1) for name, mask in kept.items()}
    if all(mask.all() for mask in kept.values()):
        return scene, *others
    return tuple(_kept(one, rows, new) for one in (scene, *others))


def _kept(scene: Scene, rows: Mapping[str, IntArray], new: Mapping[str, IntArray]) -> Scene:
    relations = {}
    for item in fields(scene.relations):
        first, second = item.name.replace("_along_", "_on_").split("_on_")
        pairs = getattr(scene.relations, item.name)
        pairs = np.column_stack([new[first][pairs[:, 0]], new[second][pairs[:, 1]]])
        relations[item.name] = pairs[(pairs >= 0).all(axis=1)]
    points, lines = scene.point_observations, scene.line_observations
    return scene.replace(
        points=scene.points.take(rows["point"]),
        point_observations=points.replace(point_idx=new["point"][points.point_idx]),
        lines=scene.lines.take(rows["line"]),
        line_observations=lines.replace(line_idx=new["line"][lines.line_idx]),
        planes=scene.planes.take(rows["plane"]),
        directions=scene.directions.take(rows["direction"]),
        relations=Relations(**relations),
    )


__all__ = ["without_unused"]
