# SPDX-License-Identifier: BSD-3-Clause
"""Points tracked from frame to frame, aligned with the patches of the last keyframe, and found by projection."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groma._rows import Rows, column
from groma._typing import FloatArray, IntArray
from groma.features.point_tracks import follow
from groma.tracking.frame.camera import TrackCamera, into
from groma.tracking.gates import PointGates
from groma.tracking.map.track_map import TrackMap


@dataclass(frozen=True, eq=False)
class PointTracks(Rows):
    """Points of the map in a frame."""

    #: (n,) landmark, (n, 2) pixel.
    index: IntArray = column(dtype=np.int64)
    pixel: FloatArray = column(2)


def follow_points(
    track_map: TrackMap,
    camera: TrackCamera,
    tracks: PointTracks,
    before: npt.NDArray[np.uint8],
    now: npt.NDArray[np.uint8],
    predicted: FloatArray,
    previous: FloatArray,
    max_correction: float,
) -> PointTracks:
    """Follow points from the frame before; those that the last keyframe saw are then held to its patches."""
    if not len(tracks):
        return tracks
    points = track_map.points
    guess = tracks.pixel.copy()
    known = points.alive[tracks.index]
    if known.any():
        # What the predicted motion adds to where each point was seen.
        places = points.xyz[tracks.index[known]]
        moved = camera.project(into(predicted, places)) - camera.project(into(previous, places))
        guess[known] += np.where(np.isfinite(moved), moved, 0.0)
        # Points whose place is not known yet move like their neighbours do.
        guess[~known] += np.median(np.where(np.isfinite(moved), moved, 0.0), axis=0)
    pixel, good = follow(before, now, tracks.pixel, guess)
    rows = np.flatnonzero(good)
    tracks = PointTracks(tracks.index[rows], pixel[rows])
    keyframe = track_map.near
    own = np.flatnonzero(points.keyframe[tracks.index] == keyframe.index)
    if keyframe.gray is not None and len(own):
        patch = points.pixel[tracks.index[own]]
        expected = tracks.pixel[own]
        pixel, good = follow(keyframe.gray, now, patch, expected, levels=0, round_trip=None, max_shift=max_correction)
        held = tracks.pixel.copy()
        held[own[good]] = pixel[good]
        tracks = PointTracks(tracks.index, held)
    return tracks


def find_again(
    track_map: TrackMap,
    camera: TrackCamera,
    now: npt.NDArray[np.uint8],
    pose: FloatArray,
    tracks: PointTracks,
    limit: int,
    gates: PointGates,
) -> PointTracks:
    """Look for points of the map that are in view but not followed, by their patches in keyframes.

    What is not found is hardly found in the next frame: it is looked for again after 1, 2, 4, ... frames in view.
    """
    points = track_map.points
    wanted = points.alive.copy()
    wanted[tracks.index] = False
    # Only landmarks of recent and overlapping keyframes; the rest of a large map is not searched in every frame.
    rows = np.flatnonzero(wanted)
    if not len(rows):
        return PointTracks.empty()
    place = into(pose, points.xyz[rows])
    pixel = camera.project(place)
    view = camera.inside(pixel, gates.border)
    rows, pixel = rows[view], pixel[view]
    living = np.array([k.alive and k.gray is not None for k in track_map.keyframes])
    rows, pixel = rows[living[points.keyframe[rows]]], pixel[living[points.keyframe[rows]]]
    if not len(rows):
        return PointTracks.empty()
    count = np.bincount(points.keyframe[rows], minlength=len(living))
    found = PointTracks.empty()
    for index in np.argsort(-count, kind="stable")[: gates.patch_keyframes]:
        of = np.flatnonzero(points.keyframe[rows] == index)[:limit]
        if not len(of):
            break
        misses = points.misses[rows[of]]
        due = misses & (misses + 1) == 0
        points.misses[rows[of[~due]]] += 1
        of = of[due]
        patch = track_map.keyframes[index].gray
        assert patch is not None
        seen = points.pixel[rows[of]]
        there, good = follow(patch, now, seen, pixel[of], levels=1, max_shift=gates.again_radius)
        points.misses[rows[of[~good]]] += 1
        points.misses[rows[of[good]]] = 0
        found = found.joined(PointTracks(rows[of[good]], there[good]))
    return found
