# SPDX-License-Identifier: BSD-3-Clause
"""Places of points from two rays."""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.geometry import se3
from groma.tracking.frame.camera import TrackCamera, back, into
from groma.tracking.gates import DEFAULT, PointGates


def triangulate(
    camera: TrackCamera,
    first: FloatArray,
    first_pixel: FloatArray,
    second: FloatArray,
    second_pixel: FloatArray,
    gates: PointGates = DEFAULT.points,
) -> tuple[FloatArray, np.ndarray]:
    """Intersect rays from many first poses (N, 7) with rays from one second pose (7,): middle of the shortest link.

    Returns (N, 3) places in the world, and which of them are in front of both cameras, with enough parallax (radians)
    and reprojected near the pixels.
    """
    origin = se3.inverse(first)[:, 4:]
    tips = se3.transform_points(se3.inverse(first), camera.bearings(first_pixel))
    ray1 = tips - origin
    ray1 /= np.linalg.norm(ray1, axis=1, keepdims=True)
    center = back(second, np.zeros((1, 3)))[0]
    ray2 = back(second, camera.bearings(second_pixel)) - center
    ray2 /= np.linalg.norm(ray2, axis=1, keepdims=True)
    cosine = (ray1 * ray2).sum(axis=1)
    sine2 = np.maximum(1.0 - cosine**2, 1e-12)
    link = center - origin
    share1 = ((link * ray1).sum(axis=1) - cosine * (link * ray2).sum(axis=1)) / sine2
    share2 = (cosine * (link * ray1).sum(axis=1) - (link * ray2).sum(axis=1)) / sine2
    places = 0.5 * (origin + share1[:, None] * ray1 + center + share2[:, None] * ray2)
    good = (np.sqrt(sine2) > gates.min_parallax) & (share1 > 0) & (share2 > 0)
    with np.errstate(invalid="ignore"):
        error1 = np.linalg.norm(camera.project(se3.transform_points(first, places)) - first_pixel, axis=1)
        error2 = np.linalg.norm(camera.project(into(second, places)) - second_pixel, axis=1)
        good &= (error1 < gates.max_error) & (error2 < gates.max_error)
    return places, good
