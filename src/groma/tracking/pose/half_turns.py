# SPDX-License-Identifier: BSD-3-Clause
"""Whether a frame may as well see the other side of what was mapped.

Boxes look the same from opposite sides, in points, lines and planes, and the side where the camera is need not be in
the map: what agrees with the pose that was found says nothing then. What the map knows can deny the other pose alone.
So poses are turned by half about each plane in view, at the middle of what was seen of it, and estimated again. Where
planes agree with such a pose and depth looks through what the map knows no more often than noise and edges explain, it
is left open which one is right. Points do not tell: what floors and tables show is not recognised from the other side.
"""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.geometry import quaternion, se3
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.frame.features import FrameFeatures
from groma.tracking.map.track_map import Keyframe, TrackMap
from groma.tracking.pose.depth_check import left_open
from groma.tracking.pose.relocalise import Found, PoseSearch, match_planes


def poses_left_open(
    track_map: TrackMap, camera: TrackCamera, data: FrameFeatures, keyframes: list[Keyframe], found: Found,
    sigma: FloatArray,
) -> list[FloatArray]:  # fmt: skip
    """Return the poses (7,) on other sides that depth does not deny; none without depth images.

    Parameters
    ----------
    track_map, camera, data
        The map, the camera, and a frame.
    keyframes
        Whose depths may deny a pose.
    found
        The pose of the frame.
    sigma : (6,)
        Standard deviations by which a turned pose may be off: translation (scene units), rotation (radians).
    """
    out, pose, planes = [], found.estimate.pose, track_map.planes
    for index in match_planes(track_map, data, pose).index:
        start = turned_by_half(pose, planes.hesse[index, :3], np.nanmean(planes.samples[index], axis=0))
        other = PoseSearch(track_map, camera, data, found.known, start, sigma).refine(start)
        # Two planes that cross hold a pose upright; along one of them anything can be seen.
        if other is None or other.estimate.counts["planes"] < 2:
            continue
        if left_open(camera, keyframes, data.depth_grid, other.estimate.pose, data.options.gates):
            out.append(other.estimate.pose)
    return out


def turned_by_half(pose: FloatArray, axis: FloatArray, centre: FloatArray) -> FloatArray:
    """Return the pose (7,) at which a camera sees what it saw, after the world has turned by half about an axis."""
    turn = 2.0 * np.outer(axis, axis) - np.eye(3)
    moved = np.concatenate([quaternion.from_matrix(turn[None])[0], centre - turn @ centre])
    return se3.compose(pose[None], moved[None])[0]
