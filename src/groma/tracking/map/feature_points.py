# SPDX-License-Identifier: BSD-3-Clause
"""Described features of keyframes that become points of the map: found again by a later frame, or placed by motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from groma._typing import FloatArray, IntArray
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.frame.descriptor_pairs import pair_anywhere
from groma.tracking.frame.features import Features
from groma.tracking.frame.measurements import PointMeasurements
from groma.tracking.map.landmarks import ALIVE, DEAD
from groma.tracking.map.points import PointTracks
from groma.tracking.map.track_map import Keyframe, TrackMap
from groma.tracking.map.triangulation import triangulate
from groma.tracking.options import TrackOptions


def match_features(first: Features, second: Features, max_bits: int) -> tuple[IntArray, IntArray]:
    """Match features by nearest descriptors within a number of bits; return the rows of both."""
    return pair_anywhere(first.descriptor, second.descriptor, max_bits)


def linked_to_points(features: Features, tracks: PointTracks, reach: float) -> Features:
    """Return the features, those within a reach (pixels) of points that are followed linked to them."""
    if not len(features.pixel) or not len(tracks):
        return features
    distance, nearest = KDTree(features.pixel).query(tracks.pixel, distance_upper_bound=reach)
    rows = np.flatnonzero(np.isfinite(distance))
    return features.linked(np.asarray(nearest)[rows], tracks.index[rows])


def points_of_features(
    track_map: TrackMap, keyframe: Keyframe, rows: IntArray, places: FloatArray, depth_sigma: FloatArray, sigma: float
) -> IntArray:
    """Make points of the map of a keyframe's features that are none; return their landmarks.

    Parameters
    ----------
    track_map, keyframe
        Where the features are.
    rows : (n,)
        Features of the keyframe.
    places : (n, 3)
        Where they are in the world.
    depth_sigma : (n,)
        Standard deviation of their depths, where known.
    sigma : float
        Standard deviation of their pixels, at the finest scale.
    """
    points, features = track_map.points, keyframe.features
    new = points.extend(len(rows))
    pixel = features.pixel[rows]
    points.xyz[new], points.state[new] = places, ALIVE
    points.keyframe[new] = points.first_keyframe[new] = keyframe.index
    points.pixel[new] = points.first_pixel[new] = pixel
    keyframe.features = features.linked(rows, new)
    nothing = np.full((len(new), 2), np.nan)
    table = PointMeasurements(new, pixel, sigma * features.scale[rows], features.depth[rows], depth_sigma, nothing)
    keyframe.measured = replace(keyframe.measured, points=PointMeasurements.stack([keyframe.measured.points, table]))
    return new


def place_by_motion(
    track_map: TrackMap,
    camera: TrackCamera,
    keyframe: Keyframe,
    features: Features,
    pose: FloatArray,
    taken: IntArray,
    options: TrackOptions,
) -> tuple[PointTracks, Features]:
    """Place features that a keyframe and a frame both see and that have no place yet.

    Parameters
    ----------
    track_map, camera
        The map and its camera.
    keyframe
        An earlier keyframe.
    features, pose
        Those of the frame, linked to the points that it is known to show, and its pose (7,).
    taken : (n,)
        Points that are followed already.
    options
        Those of the track.

    Returns
    -------
    PointTracks, Features
        The points as they are followed from now on, and the features linked to them.
    """
    points, own = track_map.points, keyframe.features
    first, second = match_features(own, features, options.gates.features.max_bits)
    index = own.point[first]
    placed = index >= 0
    placed[placed] = points.state[index[placed]] == ALIVE
    free = ~placed & (features.point[second] < 0)
    first, second = first[free], second[free]
    if not len(first):
        return PointTracks.empty(), features
    poses = np.tile(keyframe.pose, (len(first), 1))
    places, good = triangulate(camera, poses, own.pixel[first], pose, features.pixel[second], options.gates.points)
    first, second, places = first[good], second[good], places[good]
    index = own.point[first]
    begun = index >= 0
    begun[begun] = points.state[index[begun]] != DEAD
    points.xyz[index[begun]], points.state[index[begun]] = places[begun], ALIVE
    fresh = ~begun
    unknown = np.full(int(fresh.sum()), np.nan)
    index[fresh] = points_of_features(track_map, keyframe, first[fresh], places[fresh], unknown, options.point_sigma_px)
    tracks = PointTracks(index, features.pixel[second])
    tracks = tracks.take(np.unique(index, return_index=True)[1])
    return tracks.take(~np.isin(tracks.index, taken)), features.linked(second, index)
