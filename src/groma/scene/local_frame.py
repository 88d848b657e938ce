# SPDX-License-Identifier: BSD-3-Clause
"""A frame near a scene that lies far from the origin of its world.

Models tied to the ground have coordinates of millions of metres: UTM, or COLMAP's alignment with GPS, which counts from
the centre of the Earth. Points lose seven digits there, and lines and planes, which are described by their moment and
their distance from the origin, twice as many: a turn of a nearby line moves that moment by a million times its length.
Whatever is computed is therefore computed near the scene, and its result moved back.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from groma.scene.similarity import Similarity

if TYPE_CHECKING:
    from groma.scene.scene import Scene

#: A scene is far from the origin if that is so many times as far as half of its cameras and points from their middle.
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
    places = np.concatenate([scene.cam_centers_in_world, scene.points.xyz])
    if len(places) == 0:
        return None
    middle = np.median(places, axis=0)
    extent = float(np.median(np.linalg.norm(places - middle, axis=1)))
    if float(np.linalg.norm(middle)) <= FAR * extent or extent == 0.0:
        return None
    return Similarity(translation=-middle)


__all__ = ["FAR", "local_frame"]
