# SPDX-License-Identifier: BSD-3-Clause
"""Evaluation of results against references, in the scores of the field, with units."""

from groma.evaluation.alignment import align_points, align_poses
from groma.evaluation.lines import LineScores, evaluate_lines, score_lines
from groma.evaluation.planes import (
    PlaneScores,
    PointPlaneScores,
    evaluate_planes,
    match_planes,
    score_planes,
    score_planes_by_points,
)
from groma.evaluation.poses import PoseScores, evaluate_poses, score_poses
from groma.io.geometry import Geometry

__all__ = [
    "Geometry",
    "LineScores",
    "PlaneScores",
    "PointPlaneScores",
    "PoseScores",
    "align_points",
    "align_poses",
    "evaluate_lines",
    "evaluate_planes",
    "evaluate_poses",
    "match_planes",
    "score_lines",
    "score_planes",
    "score_planes_by_points",
    "score_poses",
]
