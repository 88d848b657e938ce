# SPDX-License-Identifier: BSD-3-Clause
"""The displayed part of each plane: the convex hull of the landmarks on it, and a colour."""

from __future__ import annotations

import numpy as np

from groma._rows import pointers_of
from groma._typing import FloatArray, IntArray
from groma.scene.scene import Scene

#: Members farther from their middle than this multiple of what holds four fifths of them are left out (convention: of
#: what is drawn).
_FAR = 3.0
#: Colours that most eyes distinguish, the first ones best.
PALETTE = np.array(
    [list(bytes.fromhex(colour)) for colour in "d64b36 2c7ac4 3a9e5c e2a028 8a63c9 26aab2 cd5c9a 826842".split()],
    np.uint8,
)


def plane_patches(scene: Scene) -> tuple[list[FloatArray], IntArray]:
    """Return a convex polygon in each plane, and how many landmarks lie on it.

    Parameters
    ----------
    scene : Scene
        Planes, and the relations of landmarks to them.

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


def patch_area(polygon: FloatArray) -> float:
    """Area of a flat polygon (n, 3), squared scene units."""
    arms = polygon[1:] - polygon[0]
    return 0.5 * float(np.linalg.norm(np.cross(arms[:-1], arms[1:]).sum(axis=0)))


def patch_groups(members: IntArray) -> IntArray:
    """Return the colour of each plane as a row of ``PALETTE``: neighbours in size, which may well touch, differ."""
    group = np.empty(len(members), np.int64)
    group[np.argsort(-members, kind="stable")] = np.arange(len(members))
    return group % len(PALETTE)


def triangle_fans(polygons: list[FloatArray]) -> tuple[FloatArray, IntArray]:
    """Return the concatenated corners (n, 3) of convex polygons, and their triangles (t, 3)."""
    begin = pointers_of([len(corners) for corners in polygons])
    triangles = [
        first + np.column_stack([np.zeros(len(corners) - 2, int), *(np.arange(len(corners) - 2) + k for k in (1, 2))])
        for first, corners in zip(begin, polygons, strict=False)
    ]
    if not polygons:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    return np.concatenate(polygons), np.concatenate(triangles).astype(np.int64)


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
