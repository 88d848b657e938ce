# SPDX-License-Identifier: BSD-3-Clause
"""A frame near a scene that lies far from the origin of its world.

Models tied to the ground have coordinates of millions of metres: UTM, or COLMAP's alignment with GPS, which counts from
the centre of the Earth. Points lose seven digits there, and lines and planes, which are described by their moment and
their distance from the origin, twice as many: a turn of a nearby line moves that moment by a million times its length.
Whatever is computed is therefore computed near the scene, and its result moved back.
"""

from __future__ import annotations

import math

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.geometry import quaternion
from groma.scene.scene import Scene
from groma.scene.similarity import Similarity

#: A scene is far from the origin if that is this many times as far as half of its cameras and points from their middle;
#: and of unusual size if these are so many units, or so many of them a unit, from there (convention: three
#: of sixteen digits are given away).
FAR = 1000.0


def local_frame(scene: Scene) -> Similarity | None:
    """Return the translation of the world that brings a far scene to the origin; None where it is near enough.

    Parameters
    ----------
    scene : Scene
        Poses, and points if there are any. The middle is that of the middle coordinates, so that a few points far away
        move nothing.

    Returns
    -------
    Similarity or None
        For :meth:`groma.scene.Scene.transformed`; scale and axes stay.
    """
    middle, extent = _middle_and_extent(scene)
    if float(np.linalg.norm(middle)) <= FAR * extent or extent == 0.0:
        return None
    return Similarity(translation=-middle)


def usual_frame(scene: Scene) -> Similarity | None:
    """Return :func:`local_frame` in a unit of length that suits the scene; None where it is usual as it is.

    For what searches: bins, trees and guards of searches are made for scenes of a usual size. The unit is a power of
    two, so that nothing is rounded.
    """
    near, (_, extent) = local_frame(scene), _middle_and_extent(scene)
    if extent == 0.0 or not np.isfinite(extent) or 1.0 / FAR <= extent <= FAR:
        return near
    scale = 2.0 ** -round(math.log2(extent))
    return Similarity(scale, translation=np.zeros(3) if near is None else scale * near.translation)


def _middle_and_extent(scene: Scene) -> tuple[FloatArray, float]:
    """Return the middle coordinates of cameras and points, and how far half of them are from there at most."""
    places = np.concatenate([scene.cam_centers_in_world, scene.points.xyz])
    if len(places) == 0:
        return np.zeros(3), 0.0
    middle = np.median(places, axis=0)
    return middle, float(np.median(np.linalg.norm(places - middle, axis=1)))


def up_of(scene: Scene, turns: IntArray | None = None) -> FloatArray:
    """Return the direction (3,) that is up: z, where heights or gravity were measured, else :func:`upward`.

    Photographs taken from above have their tops to the north, not up. Those of a camera that was held on its side are
    upright after quarter turns to the right, ``turns`` (N,).
    """
    has_heights = len(scene.camera_positions) + int(scene.control_points.is_control.sum()) > 1
    if has_heights or len(scene.known_directions):
        return np.array([0.0, 0.0, 1.0])
    axes = quaternion.to_matrix(scene.cam_from_world[:, :4])
    if turns is not None:
        cosine, sine = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])[turns].T[:, :, None]
        x, y, z = axes.swapaxes(0, 1)
        axes = np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=1)
    return upward(axes)


def upward(axes: FloatArray) -> FloatArray:
    """Return the direction (3,) to the tops of photographs; against the view where that differs less, as from above.

    A drone turns around at the end of each strip: its photographs have their tops on both sides, and look down alike.
    z if neither direction is common to them.

    Parameters
    ----------
    axes : (N, 3, 3) float64
        Rows are the x, y and z axes of a camera, in the world.
    """
    tops, back = -axes[:, 1].sum(axis=0), -axes[:, 2].sum(axis=0)
    # derived from tops of which half are turned by a quarter, as of a telephone: their mean is longer than this
    differ = np.linalg.norm(tops) < min(0.7 * len(axes), np.linalg.norm(back))
    up = back if differ else tops
    length = np.linalg.norm(up)
    return up / length if length > 0.3 * len(axes) else np.array([0.0, 0.0, 1.0])
