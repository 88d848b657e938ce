# SPDX-License-Identifier: BSD-3-Clause
r"""Cameras of unknown calibration that may only have turned.

A camera that turns on the spot tells no depth. Where nobody measured its calibration, its images fit a camera that
moves as well, with a wrong focal length: moving sidewise with a long one looks like turning, and no deviation says so.
In comes an adjusted scene; out comes a sentence, or none. A few images that lie far apart are fitted by a rotation
each, and for each camera a focal length f and two coefficients of the division model, r being the radius of (x, y):

.. math:: d_{ij} \sim (x, y, f (1 + k_1 r^2 + k_2 r^4)), \qquad R_i^\top d_{ij} = m_j \text{ for all images } i ,

where the direction m of a point is the mean of its rays. Images with parallax miss it by tens of pixels.

Reference: A. Fitzgibbon, *Simultaneous linear estimation of multiple view geometry and lens distortion*, CVPR 2001,
for the division model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.gates import gate
from groma.geometry import quaternion, so3
from groma.scene import Scene


@dataclass(frozen=True)
class TurningGates:
    """When a camera that only turns fits the images."""

    share: float = gate(
        0.5, "share", "of the observations that it fits",
        "convention: half; 0.6 to 0.9 for a tripod, 0.02 to 0.2 where cameras moved",
    )  # fmt: skip
    limit: float = gate(2.0, "ratio", "distance within which it does, to that of inliers", "convention: a factor of 2")
    images: int = gate(8, "images", "that are fitted", "cost: time")
    points: int = gate(300, "points", "that are fitted", "cost: time")
    common: int = gate(30, "points", "that an image shares with those before it", "convention: twice COLMAP's matches")
    rounds: int = gate(20, "rounds", "of mean rays and rotations, before all is fitted", "cost: time")
    steps: int = gate(30, "steps", "of that fit", "cost: time")


GATES = TurningGates()
#: Fields of view over the diagonal, degrees, and distortions at which the fit is begun (cost: time).
_STARTS = tuple((view, k) for view in (30.0, 60.0, 90.0, 120.0) for k in (0.0, -0.3))
#: Logarithms of focal lengths and coefficients go no farther from where they began; it only guards from overflow.
_FAR = 7.0
#: Steps of Newton's method to the radius of a ray, from that of the observation.
_NEWTON = 3


def motion_that_may_be_turning(scene: Scene, free: bool | None, inliers: Mapping[str, Mapping[str, Any]]) -> str | None:
    """Return a sentence where a camera that only turns fits the points; None where images tell motion from turning.

    Parameters
    ----------
    scene : Scene
        After its adjustment.
    free : bool, optional
        Whether its calibration was estimated; None: of cameras whose calibration was not given.
    inliers : mapping
        How its points fit, as :func:`groma.adjustment.fit.inliers` returns it.
    """
    free = len(scene.principal_point_priors) > 0 if free is None else free
    told = scene.has_scale or scene.is_tied or len(scene.pose_priors) > 0 or not scene.has_trivial_rigs
    if not free or told or "points" not in inliers:
        return None
    images, limit_px = _far_apart(scene), inliers["points"]["limit_px"]
    seen = _seen(scene, images)
    if seen is None:
        return None
    from scipy.optimize import least_squares  # takes a third of a second to import

    num = len(seen.cameras)
    start = quaternion.to_matrix(scene.cam_from_world[images, :4])

    def unpack(x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        moved = so3.exp(np.vstack([np.zeros(3), x[3 * num :].reshape(-1, 3)]))
        lens = np.clip(x[: 3 * num], -_FAR, _FAR).reshape(3, num)
        return focal * np.exp(lens[0]), k + lens[1:], moved @ turn

    begun = [_turned(seen, 1.0 / np.tan(np.radians(view) / 2.0), k, start) for view, k in _STARTS]
    focal, k, turn = min(begun, key=lambda one: float(np.median(_misses(seen, *one))))
    found = least_squares(
        lambda x: _residuals(seen, *unpack(x)).ravel() / limit_px,
        np.zeros(3 * (num + len(images) - 1)),
        loss="cauchy",
        max_nfev=GATES.steps,
        x_scale="jac",
    )
    fits = float(np.mean(_misses(seen, *unpack(found.x)) <= GATES.limit * limit_px))
    if fits < GATES.share:
        return None
    most = int(np.bincount(seen.camera).argmax())
    length = unpack(found.x)[0][most] * seen.half[most]
    return (
        f"The camera may only have turned: without any motion, and with a focal length of {length:,.0f} instead of "
        f"{scene.cameras.params[seen.cameras[most]][0]:,.0f} pixels, {100 * fits:.0f} % of the observations fit to "
        f"{GATES.limit * limit_px:.2g} px. Focal length, places of cameras and depths may be wrong by far more than "
        "their deviations say. Add photographs from other places, or give the calibration."
    )


@dataclass(frozen=True)
class _Seen:
    """What is fitted: of each observation its image, point, camera and place, in half diagonals from the centre."""

    image: IntArray
    point: IntArray
    camera: IntArray
    place: FloatArray
    #: (n,) half diagonals, pixels, by what the mean of few rays takes from a residual.
    px: FloatArray
    #: (C,) rows of the cameras in the scene, and half diagonals, pixels.
    cameras: IntArray
    half: FloatArray


def _far_apart(scene: Scene) -> IntArray:
    """Return images that share points, one far from the other."""
    image, point = scene.point_observations.image_idx, scene.point_observations.point_idx
    centers, shown = scene.cam_centers_in_world, np.zeros(scene.num_points, bool)
    chosen = [int(np.bincount(image).argmax())]
    while len(chosen) < GATES.images:
        shown[point[image == chosen[-1]]] = True
        common = np.bincount(image[shown[point]], minlength=len(centers))
        away = np.linalg.norm(centers[:, None] - centers[chosen], axis=2).min(1)
        away[common < GATES.common] = -1.0
        away[chosen] = -1.0
        if away.max() < 0.0:
            break
        chosen.append(int(away.argmax()))
    return np.array(chosen)


def _seen(scene: Scene, images: IntArray) -> _Seen | None:
    """Return what is fitted of images; None where it is too little."""
    rows = scene.point_observations
    image = np.full(scene.num_images, -1)
    image[images] = np.arange(len(images))
    rows = rows.take(image[rows.image_idx] >= 0)
    count = np.bincount(rows.point_idx, minlength=scene.num_points)
    points = np.flatnonzero(count > 1)
    if len(images) < 2 or len(points) < GATES.common:
        return None
    points = points[np.linspace(0, len(points) - 1, min(len(points), GATES.points)).astype(int)]
    rows = rows.take(np.isin(rows.point_idx, points))
    camera_idx = scene.images.camera_idx[rows.image_idx]
    cameras, camera = np.unique(camera_idx, return_inverse=True)
    size = np.stack([scene.cameras.width, scene.cameras.height], axis=1)[cameras].astype(float)
    if not size.all():
        return None
    half, count = np.linalg.norm(size, axis=1) / 2.0, count[rows.point_idx]
    px = half[camera] * np.sqrt(count / (count - 1))
    place = (rows.pixel - size[camera] / 2.0) / half[camera][:, None]
    point = np.searchsorted(points, rows.point_idx)
    return _Seen(image[rows.image_idx], point, camera, place, px, cameras, half)


def _rays(seen: _Seen, focal: FloatArray, k: FloatArray) -> FloatArray:
    """Return the rays (n, 3) of observations, of length 1."""
    square, (k1, k2) = np.sum(seen.place**2, axis=1), k[:, seen.camera]
    depth = focal[seen.camera] * (1.0 + square * (k1 + square * k2))
    rays = np.column_stack([seen.place, depth])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _means(seen: _Seen, turn: FloatArray, rays: FloatArray) -> FloatArray:
    """Return for each observation the mean ray (n, 3) of its point, in its image."""
    total = np.zeros((seen.point.max() + 1, 3))
    np.add.at(total, seen.point, np.einsum("nji,nj->ni", turn[seen.image], rays))
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    return np.einsum("nij,nj->ni", turn[seen.image], total[seen.point])


def _residuals(seen: _Seen, focal: FloatArray, k: FloatArray, turn: FloatArray) -> FloatArray:
    """Return the distances (n, 2) of the mean rays of points from where they were observed, pixels."""
    mean = _means(seen, turn, _rays(seen, focal, k))
    side, (k1, k2) = np.linalg.norm(mean[:, :2], axis=1), k[:, seen.camera]
    steep, radius = focal[seen.camera] * side, np.linalg.norm(seen.place, axis=1)
    for _ in range(_NEWTON):
        square = radius**2
        gap = radius * mean[:, 2] - steep * (1.0 + square * (k1 + square * k2))
        slope = mean[:, 2] - 2.0 * steep * radius * (k1 + 2.0 * square * k2)
        radius = np.clip(radius - gap / np.where(np.abs(slope) > 1e-6, slope, 1e-6), 0.0, 10.0)
    return (mean[:, :2] * (radius / np.maximum(side, 1e-12))[:, None] - seen.place) * seen.px[:, None]


def _misses(seen: _Seen, focal: FloatArray, k: FloatArray, turn: FloatArray) -> FloatArray:
    return np.linalg.norm(_residuals(seen, focal, k, turn), axis=1)


def _turned(seen: _Seen, focal: float, k: float, turn: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return focal lengths, distortions and the rotations by which rays come near to their means, in turn."""
    every = np.full(len(seen.cameras), focal), np.vstack([np.full(len(seen.cameras), k), np.zeros(len(seen.cameras))])
    rays = _rays(seen, *every)
    for _ in range(GATES.rounds):
        mean = _means(seen, turn, rays)
        gap = np.linalg.norm(mean - rays, axis=1)
        weight = 1.0 / (1.0 + (gap / max(float(np.median(gap)), 1e-12)) ** 2)
        in_world = np.einsum("nji,nj->ni", turn[seen.image], mean)
        moment = np.zeros((len(turn), 3, 3))
        np.add.at(moment, seen.image, weight[:, None, None] * rays[:, :, None] * in_world[:, None, :])
        turn = so3.nearest(moment)
    return *every, turn
