# SPDX-License-Identifier: BSD-3-Clause
"""The beginning of a track: one frame where depth is known, else two frames with enough motion between them.

With one camera alone the first and a second frame propose motions (:mod:`groma.tracking.pose.two_views`), up to scale:
the median depth of the first points becomes the unit of length. Later frames judge them. The map starts when one
motion is left, explains most points, and their depths are known; if none explains the points, all begins anew.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from groma._typing import FloatArray
from groma.features.point_tracks import follow
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.frame.features import FrameFeatures
from groma.tracking.map.keyframes import Followed, add_keyframe
from groma.tracking.map.landmarks import ALIVE
from groma.tracking.map.lines import FollowedSegments
from groma.tracking.map.points import PointTracks
from groma.tracking.map.track_map import TrackMap
from groma.tracking.map.triangulation import triangulate
from groma.tracking.options import TrackOptions
from groma.tracking.pose.start_deviation import start_deviation
from groma.tracking.pose.two_views import IDENTITY, Candidate, likely, proposed, proposed_by_ends, with_third


class Initialiser:
    """Waits for frames a map can be made of."""

    def __init__(self, camera: TrackCamera, options: TrackOptions) -> None:
        self._camera, self._options, self._gates = camera, options, options.gates.start
        self.metric = True
        self._first: FrameFeatures | None = None
        self._before: FrameFeatures | None = None
        #: Pixels of the points followed: in the first frame, in that which proposed candidates, and in the last.
        self._views = [np.zeros((0, 2)), np.zeros((0, 2))]
        self._candidates: list[Candidate] = []
        self._second: FrameFeatures | None = None
        self._pose = IDENTITY

    def try_start(self, data: FrameFeatures) -> FloatArray | None:
        """Return the poses (n, 7) of the frames that make the first map, or None to go on waiting."""
        if data.frame.depth is not None or data.frame.right is not None:
            return self._start_by_depth(data)
        self.metric = False
        if self._first is None or not len(self._views[0]):
            return self._restart(data)
        assert self._before is not None
        pixel, good = follow(self._before.gray, data.gray, self._views[-1])
        self._views = [view[good] for view in self._views[:-1]] + [pixel[good]]
        self._candidates = [replace(one, places=one.places[good], agrees=one.agrees[good]) for one in self._candidates]
        self._before = data
        if good.sum() < self._gates.min_points:
            return self._restart(data)
        away = float(np.median(np.linalg.norm(self._views[-1] - self._views[0], axis=1)))
        assert self._first is not None
        gone = 1.0 - len(pixel[good]) / len(self._first.features.pixel)  # of one who drives ahead, those that move far
        if away < self._gates.min_displacement * self._camera.width and gone < self._gates.most_gone:
            return None
        return self._judge(data) if self._candidates else self._propose()

    def _start_by_depth(self, data: FrameFeatures) -> FloatArray | None:
        known = int(np.isfinite(data.features.depth).sum())
        if data.options.lines:
            known += 2 * int(np.isfinite(data.detected.inverse_depth).all(axis=1).sum())
        if data.planes is not None:
            known += 5 * len(data.planes)
        if known < self._gates.min_known:
            return None
        self._first = data
        return IDENTITY[None]

    def _restart(self, data: FrameFeatures) -> None:
        self._first = self._before = data
        self._candidates = []
        self._views = [data.features.pixel.copy(), data.features.pixel.copy()]

    def _propose(self) -> None:
        """Find the motions that the first and the present frame allow; the next frames will judge them."""
        one, two = self._views
        self._candidates = proposed(self._camera, np.stack([one, two]), self._options.point_sigma_px, self._gates)
        if self._candidates:
            self._views = [one, two, two.copy()]

    def _judge(self, data: FrameFeatures) -> FloatArray | None:
        """Adjust all candidates to the three views; return the poses of the one that is left and good."""
        gates, seen = self._gates, (np.stack(self._views), self._options.point_sigma_px, self._gates)
        left = likely([with_third(self._camera, candidate, *seen) for candidate in self._candidates], gates)
        if self._is_known(left):
            # The right motion may not have been proposed when the parallax was less.
            left = likely([*left, *proposed_by_ends(self._camera, *seen)], gates)
        best = left[0]
        if best.agrees.sum() < max(gates.min_points, gates.min_inliers * len(best.agrees)):
            return self._restart(data)
        self._candidates = left
        if not self._is_known(left):
            return None
        self._pose, self._second = best.poses[-1], data
        return np.stack([IDENTITY, self._pose])

    def _is_known(self, left: list[Candidate]) -> bool:
        """Whether one motion is left, and known well, and the depths of its points with it."""
        best, sigma = left[0], self._options.point_sigma_px
        if len(left) > 1 or best.agrees.sum() < self._gates.min_points:
            return False
        return start_deviation(self._camera, best, np.stack(self._views), sigma) <= self._gates.depth_sigma

    def make_map(self, track_map: TrackMap) -> tuple[Followed, FloatArray]:
        """Fill an empty map; return what is followed from now on, and the pose of the newest frame."""
        assert self._first is not None
        options, camera = self._options, self._camera
        if self._second is None:
            followed = add_keyframe(track_map, self._first, IDENTITY, Followed.nothing())
            return followed, IDENTITY.copy()
        followed = add_keyframe(track_map, self._first, IDENTITY, Followed.nothing())
        # The points of the first frame, followed once more to the second.
        tracks = followed.points
        start, end = self._views[0], self._views[-1]
        guess = tracks.pixel + _shift_near(start, end - start, tracks.pixel)
        pixel, good = follow(self._first.gray, self._second.gray, tracks.pixel, guess)
        tracks = PointTracks(tracks.index[good], pixel[good])
        first = np.tile(IDENTITY, (len(tracks), 1))
        places, placed = triangulate(
            camera, first, track_map.points.first_pixel[tracks.index], self._pose, tracks.pixel, options.gates.points
        )
        index = tracks.index[placed]
        track_map.points.xyz[index], track_map.points.state[index] = places[placed], ALIVE
        followed = Followed(tracks, FollowedSegments.empty())
        followed = add_keyframe(track_map, self._second, self._pose, followed)
        return followed, self._pose.copy()


def _shift_near(places: FloatArray, shift: FloatArray, wanted: FloatArray) -> FloatArray:
    """Median shift of the four nearest of some places."""
    near = KDTree(places).query(wanted, k=min(4, len(places)))[1].reshape(len(wanted), -1)
    return np.median(shift[near], axis=1)
