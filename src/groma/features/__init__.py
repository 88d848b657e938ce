# SPDX-License-Identifier: BSD-3-Clause
"""Lines in images: detect, describe, match."""

from groma.features.contract import ImageRetrieval, ImageView, SegmentDetector, SegmentMatcher
from groma.features.external import ExternalMatches, read_matches, write_matches
from groma.features.lsd import LsdDetector
from groma.features.matches import LineMatches
from groma.features.matching.descriptor import describe
from groma.features.matching.flow import FlowOptions, dense_flow, match_by_flow
from groma.features.matching.nearby import NearbyPoints, nearby_points
from groma.features.matching.wide_baseline import WideBaselineOptions, fundamental_from_poses, match_wide_baseline
from groma.features.segments import Segments

__all__ = [
    "ExternalMatches",
    "FlowOptions",
    "ImageRetrieval",
    "ImageView",
    "LineMatches",
    "LsdDetector",
    "NearbyPoints",
    "SegmentDetector",
    "SegmentMatcher",
    "Segments",
    "WideBaselineOptions",
    "dense_flow",
    "describe",
    "fundamental_from_poses",
    "match_by_flow",
    "match_wide_baseline",
    "nearby_points",
    "read_matches",
    "write_matches",
]
