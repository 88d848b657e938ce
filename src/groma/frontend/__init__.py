# SPDX-License-Identifier: BSD-3-Clause
"""Lines in images: detect, describe, match."""

from groma.frontend.descriptor import describe
from groma.frontend.detector import SegmentDetector
from groma.frontend.external import ExternalMatches, read_matches, write_matches
from groma.frontend.flow_matching import FlowOptions, dense_flow, match_by_flow
from groma.frontend.lsd import LsdDetector
from groma.frontend.matches import LineMatches
from groma.frontend.matching import WideBaselineOptions, fundamental_from_poses, match_wide_baseline
from groma.frontend.nearby import NearbyPoints, nearby_points
from groma.frontend.segments import Segments

__all__ = [
    "ExternalMatches",
    "FlowOptions",
    "LineMatches",
    "LsdDetector",
    "NearbyPoints",
    "SegmentDetector",
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
