# SPDX-License-Identifier: BSD-3-Clause
"""The beginning of a track: one frame where depth is known, else two frames with enough motion between them.

With one camera alone the relative pose comes from the essential matrix (five points, RANSAC), up to scale: the median
depth of the first points becomes the unit of length.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial import KDTree

from groma._typing import FloatArray
from groma.features.point_tracks import follow
from groma.geometry import quaternion, se3
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.frame.features import FrameFeatures
from groma.tracking.map.keyframes import Followed, add_keyframe
from groma.tracking.map.landmarks import ALIVE
from groma.tracking.map.lines import FollowedSegments
from groma.tracking.map.points import PointTracks
from groma.tracking.map.track_map import TrackMap
from groma.tracking.map.triangulation import triangulate
from groma.tracking.options import TrackOptions

IDENTITY = np.array([0, 0, 0, 1, 0, 0, 0.0])


class Initialiser:
    """Waits for frames a map can be made of."""

    def __init__(self, camera: TrackCamera, options: TrackOptions) -> None:
        self._camera, self._options, self._gates = camera, options, options.gates.start
        self.metric = True
        self._first: FrameFeatures | None = None
        self._before: FrameFeatures | None = None
        self._pixel = np.zeros((0, 2))
        self._start = np.zeros((0, 2))
        self._second: FrameFeatures | None = None
        self._pose = IDENTITY

    def try_start(self, data: FrameFeatures) -> FloatArray | None:
        """Return the poses (n, 7) of the frames that make the first map, or None to go on waiting."""
        if data.frame.depth is not None or data.frame.right is not None:
            known = int(np.isfinite(data.features.depth).sum())
            if data.options.lines:
                known += 2 * int(np.isfinite(data.detected.inverse_depth).all(axis=1).sum())
            if data.planes is not None:
                known += 5 * len(data.planes)
            if known < self._gates.min_known:
                return None
            self._first = data
            return IDENTITY[None]
        self.metric = False
        if self._first is None or not len(self._pixel):
            return self._restart(data)
        assert self._before is not None
        pixel, good = follow(self._before.gray, data.gray, self._pixel)
        self._start, self._pixel, self._before = self._start[good], pixel[good], data
        if len(self._pixel) < self._gates.min_points:
            return self._restart(data)
        away = float(np.median(np.linalg.norm(self._pixel - self._start, axis=1)))
        if away < self._gates.min_displacement * self._camera.width:
            return None
        pose = self._relative_pose()
        if pose is None:
            return None
        self._pose, self._second = pose, data
        return np.stack([IDENTITY, pose])

    def _restart(self, data: FrameFeatures) -> None:
        self._first = self._before = data
        self._pixel = self._start = data.features.pixel.copy()

    def _relative_pose(self) -> FloatArray | None:
        K, gates = self._camera.matrix_opencv, self._gates
        one, two = self._start - 0.5, self._pixel - 0.5
        E, mask = cv2.findEssentialMat(one, two, K, method=cv2.USAC_MAGSAC, prob=0.999, threshold=gates.max_error)
        if E is None or E.shape != (3, 3):
            return None
        count, R, t, mask = cv2.recoverPose(E, one, two, K, mask=mask)
        if count < gates.min_points or count < gates.min_inliers * len(one):
            return None
        pose = np.concatenate([quaternion.from_matrix(np.asarray(R, np.float64)), np.asarray(t, np.float64).ravel()])
        first = np.tile(IDENTITY, (len(one), 1))
        placing = replace(self._options.gates.points, min_parallax=gates.min_parallax / 2)
        places, good = triangulate(self._camera, first, self._start, pose, self._pixel, placing)
        if good.sum() < gates.min_points:
            return None
        ray1 = places[good] / np.linalg.norm(places[good], axis=1, keepdims=True)
        center = se3.inverse(pose[None])[0, 4:]
        ray2 = places[good] - center
        ray2 /= np.linalg.norm(ray2, axis=1, keepdims=True)
        parallax = np.arccos(np.clip((ray1 * ray2).sum(axis=1), -1, 1))
        if np.median(parallax) < gates.min_parallax:
            return None
        pose[4:] /= float(np.median(places[good, 2]))
        return pose

    def make_map(self, track_map: TrackMap) -> tuple[Followed, FloatArray]:
        """Fill an empty map; return what is followed from now on, and the pose of the newest frame."""
        assert self._first is not None
        options, camera = self._options, self._camera
        if self._second is None:
            followed = add_keyframe(track_map, camera, self._first, IDENTITY, Followed.nothing(), options)
            return followed, IDENTITY.copy()
        followed = add_keyframe(track_map, camera, self._first, IDENTITY, Followed.nothing(), options)
        # The points of the first frame, followed once more to the second.
        tracks = followed.points
        guess = tracks.pixel + _shift_near(self._start, self._pixel - self._start, tracks.pixel)
        pixel, good = follow(self._first.gray, self._second.gray, tracks.pixel, guess)
        tracks = PointTracks.fine(tracks.index[good], pixel[good])
        first = np.tile(IDENTITY, (len(tracks), 1))
        places, placed = triangulate(
            camera, first, track_map.points.first_pixel[tracks.index], self._pose, tracks.pixel, options.gates.points
        )
        index = tracks.index[placed]
        track_map.points.xyz[index], track_map.points.state[index] = places[placed], ALIVE
        followed = Followed(tracks, FollowedSegments.empty())
        followed = add_keyframe(track_map, camera, self._second, self._pose, followed, options)
        return followed, self._pose.copy()


def _shift_near(places: FloatArray, shift: FloatArray, wanted: FloatArray) -> FloatArray:
    """Median shift of the four nearest of some places."""
    near = KDTree(places).query(wanted, k=min(4, len(places)))[1].reshape(len(wanted), -1)
    return np.median(shift[near], axis=1)


__all__ = ["Initialiser"]
