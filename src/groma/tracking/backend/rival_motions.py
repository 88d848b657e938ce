# SPDX-License-Identifier: BSD-3-Clause
"""Whether another motion than that of the map fits features that were matched without it, for a single camera.

A track that began with a wrong motion goes on with it: points that do not agree are left out, and the residuals of the
others are hardly larger than those of a right track. But what is matched by descriptors between three keyframes does
not know the map. The map's motion, adjusted to these features, is compared with those that two views propose, as at
the start (:mod:`groma.tracking.pose.two_views`). There a motion is ruled out by odds of 1 in 100, so a few places of a
right track may be; more are not chance.
"""

from __future__ import annotations

import math

import numpy as np

from groma._typing import FloatArray
from groma.estimators.association import log10_binomial_tail
from groma.gates import NORMAL
from groma.geometry import se3
from groma.tracking.backend.described_tracks import described_tracks
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.gates import TrackingGates
from groma.tracking.map.track_map import Keyframe, TrackMap
from groma.tracking.pose.two_views import Candidate, adjusted, behind, intersected, proposed_by_ends

#: Places along a track that are looked at (cost: 0.3 seconds each).
_PLACES = 10


def motion_that_does_not_fit(track_map: TrackMap, camera: TrackCamera, gates: TrackingGates, sigma: float) -> list[str]:
    """Say so where other motions than those of a map explain features clearly better, at more places than by chance."""
    living = track_map.living()
    begins = np.unique(np.linspace(0, len(living) - 3, _PLACES).astype(int)) if len(living) > 2 else []
    told = [_is_ruled_out(living[k : k + 3], camera, gates, sigma) for k in begins]
    looked, out = sum(one is not None for one in told), sum(one is True for one in told)
    if not log10_binomial_tail(out - 1, looked, NORMAL.false_alarm) < math.log10(NORMAL.never):
        return []
    return [
        f"The motion of the camera is doubtful: at {out} of {looked} places along the track features that were matched "
        "between keyframes fit another motion clearly better (0 expected). Begin at another frame, where the camera "
        "moves sideways, and check its calibration."
    ]


def _is_ruled_out(three: list[Keyframe], camera: TrackCamera, gates: TrackingGates, sigma: float) -> bool | None:
    """Whether another motion explains what three keyframes see clearly better; None if they see too little."""
    pixels = _seen_by_all(described_tracks(TrackMap(keyframes=three), camera, gates, sigma))
    if pixels.shape[1] < gates.start.min_points:
        return None
    poses = np.array([keyframe.pose for keyframe in three])
    poses = se3.compose(poses, np.tile(se3.inverse(poses[:1]), (3, 1)))
    if not poses[2, 4:].any():
        return None
    own = Candidate(poses, intersected(camera, pixels[0], pixels[2], poses[2]))
    own = adjusted(camera, own, pixels, sigma, NORMAL.coordinate)
    rivals = proposed_by_ends(camera, pixels, sigma, gates.start)
    return any(behind(own, rival, gates.start) for rival in rivals)


def _seen_by_all(described: TrackMap) -> FloatArray:
    """Pixels (3, N, 2) of the features that were matched through all keyframes."""
    tables = [keyframe.measured.points for keyframe in described.keyframes]
    common = tables[0].index
    for table in tables[1:]:
        common = np.intersect1d(common, table.index)
    pixels = []
    for table in tables:
        order = np.argsort(table.index)
        pixels.append(table.pixel[order[np.searchsorted(table.index[order], common)]])
    return np.array(pixels)
