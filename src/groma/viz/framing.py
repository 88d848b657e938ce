# SPDX-License-Identifier: BSD-3-Clause
r"""Initial viewpoint of the 3D view: behind the cameras and a little above, as near as the landmarks allow.

Cameras around the scene are in the picture, too, unless the landmarks would become small.

Outliers (wrong matches, the horizon, a stray camera) are ignored. Everything else fills the picture: with :math:`r` and
:math:`u` the coordinates of a place to the right and upwards, :math:`b` that towards the viewer, and :math:`a` the
tangent of half the opening, the viewer at :math:`(p_r, p_u, e)` sees it if :math:`|r - p_r| \le a_r (e - b)` and
:math:`|u - p_u| \le a_u (e - b)`. The least :math:`e` is that of the two extreme places on either side, in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.io.drawn import typical_gap
from groma.viz.drawable import Drawable

#: Shares of landmarks and of cameras, nearest to the middle first, that are considered.
LANDMARK_SHARE, CAMERA_SHARE = 0.95, 0.98
#: Landmarks farther from the middle than this many times the median are ignored, too.
FAR = 4.0
#: Quantile of the landmarks that must be in the picture, on each side.
EDGE = 0.997
#: Tangents of half the opening of the viewer, across and upwards. Its focal length is 0.6 times its width (at most 1.1
#: of its height), and it is about four thirds as wide as high.
OPENING = np.array([0.83, 0.6])
#: Margin around them.
MARGIN = 1.06
#: Factor by which the distance may grow for the cameras to be in the picture.
FOR_CAMERAS = 1.15
#: Angle aside, and least angle above, radians; of photographs from higher up half of theirs.
ASIDE, ABOVE = 0.45, 0.38


@dataclass(frozen=True)
class StartingView:
    """Initial viewpoint of a viewer that orbits a pivot."""

    pivot: FloatArray
    up: FloatArray
    azimuth: float
    elevation: float
    distance: float
    camera_size: float


def starting_view(scene: Drawable, middle: FloatArray) -> StartingView:
    """Return a view of cameras, points and lines without outliers.

    Parameters
    ----------
    scene : Drawable
        What is drawn.
    middle : (3,) float64
        Target if the scene has no landmarks.
    """
    points, segments = (_finite(places) for places in (scene.points[:, None], scene.segments))
    landmarks = np.concatenate([points.reshape(-1, 3), segments.reshape(-1, 3)])
    center = np.median(landmarks, axis=0) if len(landmarks) else middle
    centers = _finite(scene.centers[:, None])
    kept = [
        places[_near(np.linalg.norm(places - center, axis=2).max(axis=1, initial=0.0), share, far)].reshape(-1, 3)
        for places, share, far in (
            (points, LANDMARK_SHARE, FAR),
            (segments, LANDMARK_SHARE, FAR),
            (centers, CAMERA_SHARE, np.inf),
        )
    ]
    places = np.concatenate(kept)
    up = scene.up
    back = kept[2].mean(axis=0) - center if len(kept[2]) else np.array([1.0, 1.0, 0.0])
    first, second = horizontal(up)
    azimuth = float(np.arctan2(back @ second, back @ first)) + ASIDE
    elevation = max(ABOVE, 0.5 * float(np.arcsin(back @ up / (np.linalg.norm(back) or 1.0))))
    back = np.cos(elevation) * (np.cos(azimuth) * first + np.sin(azimuth) * second) + np.sin(elevation) * up
    right = np.cross(up, back) / np.cos(elevation)
    frame = np.stack([right, np.cross(back, right), back])
    if not len(places):
        return StartingView(center, up, azimuth, elevation, 1.0, 0.018)
    pivot, distance = _compromise((np.concatenate(kept[:2]) - center) @ frame.T, (kept[2] - center) @ frame.T)
    return StartingView(center + pivot @ frame, up, azimuth, elevation, distance, _camera_size(scene, distance))


def horizontal(up: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return two unit vectors across ``up``, from which the page measures azimuths."""
    helper = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    first = np.cross(helper, up)
    first /= np.linalg.norm(first)
    return first, np.cross(up, first)


def _finite(places: FloatArray) -> FloatArray:
    """Items (N, k, 3) whose places are finite in single precision, in which a page holds them."""
    return places[(np.abs(places) <= np.finfo(np.float32).max).all(axis=(1, 2))]


def _near(distances: FloatArray, share: float, far: float) -> BoolArray:
    if not len(distances):
        return np.zeros(0, dtype=bool)
    usual = float(np.median(distances))
    return distances <= min(float(np.quantile(distances, share, method="higher")), far * usual if usual else np.inf)


def _compromise(landmarks: FloatArray, cameras: FloatArray) -> tuple[FloatArray, float]:
    """Return pivot and distance for the landmarks, moved towards those for landmarks and cameras within the limit.

    What is visible from two viewpoints is visible from all between them, because the conditions are linear.
    """
    pivot, distance = _fitted(landmarks, cameras)
    if not (len(landmarks) and len(cameras)):
        return pivot, distance
    near_pivot, near = _fitted(landmarks, cameras[:0])
    # The viewers stand at pivot + distance * back: compare them along that axis.
    share = min(1.0, (FOR_CAMERAS - 1.0) * near / max(distance + pivot[2] - near - near_pivot[2], 1e-300))
    if share < 0.0 or share >= 1.0:
        return pivot, distance
    viewer, near_viewer = (at + np.array([0.0, 0.0, far]) for at, far in ((pivot, distance), (near_pivot, near)))
    viewer = near_viewer + share * (viewer - near_viewer)
    pivot = np.array([viewer[0], viewer[1], near_pivot[2]])
    return pivot, float(viewer[2] - pivot[2])


def _fitted(landmarks: FloatArray, cameras: FloatArray) -> tuple[FloatArray, float]:
    """Return the pivot and the distance from which places (N, 3), as right, up and back, fill the picture."""
    places = np.concatenate([landmarks, cameras])
    opening = OPENING / MARGIN

    def reach(sign: float) -> FloatArray:
        of_landmarks, of_cameras = (sign * part[:, :2] + opening * part[:, 2:] for part in (landmarks, cameras))
        few = [np.quantile(of_landmarks, EDGE, axis=0)] if len(of_landmarks) else []
        return np.max([*few, *of_cameras], axis=0)

    high, low = reach(1.0), reach(-1.0)
    eye = float(((high + low) / (2 * opening)).max())
    near, far = np.quantile(places[:, 2], [1 - EDGE, EDGE])
    depth, extent = 0.5 * float(near + far), float(np.ptp(places, axis=0).max())
    distance = max(eye - depth, 0.3 * extent) or 1.0
    return np.array([*(0.5 * (high - low)), depth]), distance


def _camera_size(scene: Drawable, distance: float) -> float:
    """Return a size at which cameras are visible and neighbours do not overlap."""
    if len(scene.centers) < 3:
        return 0.018 * distance
    return float(np.clip(0.4 * typical_gap(scene.centers), 0.004 * distance, 0.018 * distance))
