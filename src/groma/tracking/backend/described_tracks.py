# SPDX-License-Identifier: BSD-3-Clause
"""Tracks of described features through the keyframes of stereo pairs, found without any map.

Tracked points are searched near their predicted place. If the map's depths are wrong, because the right
camera is turned, those that slide along their epipolar line to where they are expected agree with it. Features that are
matched by their descriptors are independent of the map, and so of the assumed pose of the right camera.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from groma._typing import FloatArray, IntArray
from groma.features.point_tracks import POINT_TRACKS, follow
from groma.tracking.frame.camera import TrackCamera, back
from groma.tracking.frame.features import Features
from groma.tracking.frame.measurements import Measurements, PointMeasurements
from groma.tracking.gates import TrackingGates
from groma.tracking.map.feature_points import match_features
from groma.tracking.map.landmarks import ALIVE
from groma.tracking.map.track_map import Keyframe, TrackMap


def described_tracks(track_map: TrackMap, camera: TrackCamera, gates: TrackingGates, sigma: float) -> TrackMap:
    """Return a map of the same keyframes whose points are features matched from each keyframe to the next.

    Parameters
    ----------
    track_map, camera
        A map of stereo pairs, and the camera of its keyframes.
    gates
        How alike descriptors are, how near to epipolar lines, and by how much a feature is refined.
    sigma
        Standard deviation of a point, pixels.
    """
    living, out = track_map.living(), TrackMap()
    pixels = [keyframe.features.pixel.copy() for keyframe in living]
    tracks = [np.full(len(pixel), -1) for pixel in pixels]
    count = 0
    for k in range(1, len(living)):
        first, second, there = _matched(living[k - 1], living[k], pixels[k - 1], camera, gates)
        begun = first[tracks[k - 1][first] < 0]
        tracks[k - 1][begun] = count + np.arange(len(begun))
        count += len(begun)
        tracks[k][second], pixels[k][second] = tracks[k - 1][first], there
    out.points.extend(count)
    for keyframe, track, pixel in zip(living, tracks, pixels, strict=True):
        _add(out, keyframe, track, pixel, camera, sigma)
    return out


def _matched(
    one: Keyframe, two: Keyframe, pixel: FloatArray, camera: TrackCamera, gates: TrackingGates
) -> tuple[IntArray, IntArray, FloatArray]:
    """Features of two keyframes that match and agree with one motion, and their refined pixels in the second."""
    first, second = match_features(one.features, two.features, gates.features.max_bits)
    if len(first) < gates.rectification.min_pairs or one.gray is None or two.gray is None:
        return first[:0], second[:0], np.zeros((0, 2))
    guess = two.features.pixel[second]
    there, good = follow(
        one.gray, two.gray, pixel[first], guess, levels=0, round_trip=None, max_shift=POINT_TRACKS.max_shift
    )
    if good.sum() < gates.rectification.min_pairs:
        return first[:0], second[:0], np.zeros((0, 2))
    _, agree = cv2.findEssentialMat(
        pixel[first[good]] - 0.5, there[good] - 0.5, camera.matrix_opencv, method=cv2.USAC_MAGSAC,
        threshold=gates.start.max_error,
    )  # fmt: skip
    rows = np.flatnonzero(good)[np.asarray(agree).ravel() > 0]
    return first[rows], second[rows], there[rows]


def _add(
    out: TrackMap, keyframe: Keyframe, track: IntArray, pixel: FloatArray, camera: TrackCamera, sigma: float
) -> None:
    """Add a keyframe that measures tracks; those without a place get one from its depths."""
    features: Features = keyframe.features
    rows = np.flatnonzero(track >= 0)
    index, depth, pixel = track[rows], features.depth[rows], pixel[rows]
    places = back(keyframe.pose, camera.bearings(pixel) * depth[:, None])
    fresh = np.isfinite(depth) & (out.points.state[index] != ALIVE)
    out.points.xyz[index[fresh]], out.points.state[index[fresh]] = places[fresh], ALIVE
    right = pixel - np.column_stack([camera.fx * camera.baseline / depth, np.zeros(len(rows))])
    unknown = np.full(len(rows), np.nan)
    table = PointMeasurements(index, pixel, np.full(len(rows), sigma), unknown, unknown, right)
    measured = replace(Measurements.empty(), points=table)
    out.keyframes.append(replace(keyframe, index=len(out.keyframes), pose=keyframe.pose.copy(), measured=measured))
