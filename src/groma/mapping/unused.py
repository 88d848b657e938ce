# SPDX-License-Identifier: BSD-3-Clause
"""Removal of unobservable landmarks: points and lines without observations, planes and directions with few members."""

from __future__ import annotations

import numpy as np

from groma.scene import Scene
from groma.scene.survey import Kind

#: Points that determine a plane, a line counting twice; lines that share a direction (derived from geometry).
_MIN_ON_PLANE, _MIN_ALONG = 3, 2


def without_unused(scene: Scene, *others: Scene) -> tuple[Scene, ...]:
    """Return a scene without its unobservable landmarks, and other scenes without the same landmarks.

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
    on_plane[scene.plane_observations.plane_idx] += _MIN_ON_PLANE  # measured in a camera, which determines it
    along = np.bincount(on["line_along_direction"], minlength=scene.num_directions)
    along[scene.held.idx[scene.held.kind == Kind.DIRECTION]] += _MIN_ALONG  # such as the vertical
    kept = {
        "points": seen["point"],
        "lines": seen["line"],
        "planes": on_plane >= _MIN_ON_PLANE,
        "directions": along >= _MIN_ALONG,
    }
    if all(mask.all() for mask in kept.values()):
        return scene, *others
    return tuple(one.keep(**kept) for one in (scene, *others))
