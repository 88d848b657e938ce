# SPDX-License-Identifier: BSD-3-Clause
"""The part of each plane that is worth drawing: the convex hull of what lies on it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from groma._typing import FloatArray, IntArray

if TYPE_CHECKING:
    from groma.scene import Scene

#: Members farther from their middle than this multiple of what holds four fifths of them are left out.
_FAR = 3.0


def plane_patches(scene: Scene) -> tuple[list[FloatArray], IntArray]:
    """Return a convex polygon in each plane, and how many landmarks lie on it.

    Parameters
    ----------
    scene : Scene
        Planes, and the relations that say what lies on them.

    Returns
    -------
    polygons : list of K arrays (n, 3)
        Corners in order, on the plane: the hull of the points and line ends that lie on it, without those far away
        from the rest; a square in the middle of the scene where there are fewer than three, or all on one line.
    members : (K,) int
        Points and lines on each plane.
    """
    everything = np.concatenate([scene.points.xyz, scene.lines.segments.reshape(-1, 3)])
    middle = np.median(everything, axis=0) if len(everything) else np.zeros(3)
    reach = float(np.median(np.linalg.norm(everything - middle, axis=1))) if len(everything) else 0.0
    on_plane = scene.relations.point_on_plane, scene.relations.line_on_plane
    polygons = []
    for index, plane in enumerate(scene.planes.hesse):
        points, lines = (pairs[pairs[:, 1] == index, 0] for pairs in on_plane)
        places = np.concatenate([scene.points.xyz[points], scene.lines.segments[lines].reshape(-1, 3)])
        normal = plane[:3]
        first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        first /= np.linalg.norm(first)
        axes = np.stack([first, np.cross(normal, first)])
        center = np.median(places, axis=0) if len(places) else middle
        origin = center - (normal @ center + plane[3]) * normal
        corners = _hull(_without_far((places - origin) @ axes.T))
        if corners is None:
            corners = 0.5 * (reach or 1.0) * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        polygons.append(origin + corners @ axes)
    members = sum(np.bincount(pairs[:, 1], minlength=scene.num_planes) for pairs in on_plane)
    return polygons, np.asarray(members, np.int64)


def _without_far(places: FloatArray) -> FloatArray:
    if len(places) < 5:
        return places
    distance = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    return places[distance <= _FAR * np.percentile(distance, 80)]


def _hull(places: FloatArray) -> FloatArray | None:
    """Return the corners of the convex hull of (n, 2) places, or None where it has no area."""
    if len(places) < 3:
        return None
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    if not spread[1] > 1e-6 * spread[0]:
        return None
    from scipy.spatial import ConvexHull

    return places[ConvexHull(places).vertices]
