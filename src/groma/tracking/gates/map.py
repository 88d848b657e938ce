# SPDX-License-Identifier: BSD-3-Clause
"""Gates of the map: keyframes, points, lines and planes, and culling."""

from __future__ import annotations

import math
from dataclasses import dataclass

from groma.estimators.plane_search import PlaneOptions
from groma.gates import SEQUENCES, gate


@dataclass(frozen=True)
class KeyframeGates:
    """When a frame becomes a keyframe, beside the options."""

    max_frames: int = gate(30, "frames", "frames between keyframes while the camera moves", SEQUENCES)
    moved: float = gate(0.25, "share", "share of the motion of a keyframe that counts as moving", SEQUENCES)
    nearby: float = gate(0.5, "share", "of the motion of a keyframe within which an older one stands for it", SEQUENCES)
    delay: int = gate(2, "frames", "after which what threads worked out is taken up", "cost: waiting for it")
    delay_seconds: float = gate(0.045, "s", "of the camera, before a keyframe is made", "cost: waiting for them")


@dataclass(frozen=True)
class PointGates:
    """Points: new, placed, and found again."""

    same_feature: float = gate(2.0, "px", "a feature within this distance of a followed point is that point", SEQUENCES)
    few: float = gate(0.33, "share", "with fewer of the wanted points, one camera places features by motion", SEQUENCES)
    corner_distance: float = gate(0.7, "cells", "distance of new corners", SEQUENCES)
    border: float = gate(8.0, "px", "of new points from the edge of the image", "derived from the patch: 15 px")
    patch_keyframes: int = gate(2, "keyframes", "whose patches are looked for in one frame", "cost: time per frame")
    again_radius: float = gate(6.0, "px", "distance at which a point of the map is found again", SEQUENCES)
    again_room: float = gate(0.2, "share", "share of the wanted points that must be missing", "cost: time per frame")
    first_of: int = gate(4, "points", "of which one is followed before the others", "cost: time per searched frame")
    min_parallax: float = gate(0.015, "rad", "angle between rays that place a point", SEQUENCES)
    max_error: float = gate(2.5, "px", "distance of a placed point from its pixels", SEQUENCES)
    max_misses: int = gate(12, "frames", "a point not found in so many frames in a row is dropped", SEQUENCES)


@dataclass(frozen=True)
class LineGates:
    """Lines: followed, assigned to detected segments, placed."""

    reduction: int = gate(2, "1", "factor by which images are reduced for the flow", "cost: time per frame")
    voters: int = gate(12, "points", "points that vote for where a segment went", SEQUENCES)
    vote_distances: tuple[float, ...] = gate((8.0, 4.0, 3.0), "px", "voters agree within, round by round", SEQUENCES)
    max_sigma: float = gate(0.45, "px", "of the edge of a segment that is found", "derived from 0.5 px if unfitted")
    weaker: float = gate(0.35, "ratio", "an edge may be weaker than it was by this factor", SEQUENCES)
    stronger: float = gate(3.0, "ratio", "and stronger", SEQUENCES)
    min_strength: float = gate(2.0, "grey levels / px", "weakest edge", SEQUENCES)
    min_sigma: float = gate(0.5, "px", "no segment is known better: lenses and edges are not straight", SEQUENCES)
    min_length: float = gate(15.0, "px", "shortest segment that is followed or looked for", SEQUENCES)
    border: float = gate(4.0, "px", "expected segments are cut at this distance from the edge of the image", SEQUENCES)
    depth_share: float = gate(0.1, "share", "inverse depths of a pair agree within this share", SEQUENCES)
    distance: float = gate(5.0, "px", "a segment is a line of the map within this distance", SEQUENCES)
    again_distance: float = gate(4.0, "px", "a line found again is this near to where the pose says", SEQUENCES)
    again_recent: int = gate(400, "lines", "newest lines that are looked for", "cost: time per frame")
    min_length_share: float = gate(0.04, "share", "a new line is longer than this share of its depth", SEQUENCES)
    max_angle: float = gate(0.15, "rad", "noise of the direction of a new line", SEQUENCES)
    min_sine: float = gate(0.03, "rad", "angle of the planes that place a line by motion", SEQUENCES)
    max_depth_ratio: float = gate(3.0, "ratio", "depths of the ends of a line placed by motion", SEQUENCES)
    max_extension: float = gate(2.0, "ratio", "a line grows by at most this factor in one keyframe", SEQUENCES)
    few_points: int = gate(120, "points", "with fewer the depth along segments is measured too", "cost: time per frame")


@dataclass(frozen=True)
class PlaneGates:
    """Planes: assigned, grown, merged."""

    angle: float = gate(math.radians(8.0), "rad", "a plane of a keyframe is one of the map within", SEQUENCES)
    distance: float = gate(0.08, "scene units", "and distance of the seen part", SEQUENCES)
    wider: float = gate(1.5, "times", "both, between frames; within them none is new", SEQUENCES)
    merge_angle: float = gate(0.06, "rad", "planes of the map are one within this angle", SEQUENCES)
    merge_distance: float = gate(0.03, "scene units", "and distance", SEQUENCES)
    reach: float = gate(0.6, "scene units", "the seen parts of one plane lie within this distance", SEQUENCES)
    box: float = gate(0.15, "scene units", "size of the boxes of which each keeps one sample", "cost: samples kept")
    box_growth: float = gate(1.3, "ratio", "boxes grow by this factor until samples fit", "cost: samples kept")
    compared: int = gate(40, "places", "places of a frame compared with the samples of a plane", "cost: time per frame")


@dataclass(frozen=True)
class LandmarkPlaneGates:
    """Planes in the points and lines of a map without depth images."""

    surface_sigmas_px: tuple[float, ...] = gate(
        (0.2, 0.8, 3.2), "px", "deviations of surfaces that are tried", "derived from photographs, x 1, 4, 16"
    )
    min_support: int = gate(PlaneOptions.min_support, "points", "on a plane (a line: 2)", "derived from the search")
    min_views: int = gate(2, "images", "that see a landmark (a pair is two); it was followed between them", SEQUENCES)


@dataclass(frozen=True)
class CullingGates:
    """Keyframes that only repeat others."""

    repeated: float = gate(0.85, "share", "share of its points that others see as well", SEQUENCES)
    seen_by: int = gate(3, "keyframes", "others that must see a point", SEQUENCES)
    newest: int = gate(4, "keyframes", "the newest keyframes are never dropped", SEQUENCES)
    min_shared: int = gate(20, "points", "points that a keyframe shares with the newest, and that it has", SEQUENCES)
    heirs: int = gate(12, "keyframes", "keyframes that inherit the patches of a dropped one", "cost: time per keyframe")
