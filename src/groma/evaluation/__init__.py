# SPDX-License-Identifier: BSD-3-Clause
"""Results against references, in the scores of the field, with units."""

from groma.evaluation.alignment import align_points, align_poses
from groma.evaluation.poses import PoseScores, evaluate_poses, score_poses

__all__ = ["PoseScores", "align_points", "align_poses", "evaluate_poses", "score_poses"]
