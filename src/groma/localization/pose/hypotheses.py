# SPDX-License-Identifier: BSD-3-Clause
r"""Poses from few matches: minimal solvers inside locally optimised RANSAC, of PoseLib.

Samples of three points, two points and a line, one point and two lines, or three lines, are solved in closed form
(Kukelova, Heller, Fitzgibbon, *Efficient intersection of three quadrics and applications in computer vision*, 2016);
what agrees with the best poses refines them. Pixels are those without distortion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.gates import NORMAL, chi_square_gate
from groma.geometry import quaternion
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.gates import HYPOTHESES
from groma.localization.pose.matches import Matches


@dataclass(frozen=True, eq=False)
class Straight:
    """The pinhole camera of a query without its distortion, and the matches there."""

    camera: dict[str, Any]
    matches: Matches
    #: Which matches of points and lines have such pixels.
    points: BoolArray
    lines: BoolArray


def straightened(camera: QueryCamera, matches: Matches) -> Straight:
    """Move what was measured to where the camera would see it without distortion."""
    points = camera.straight(matches.points2d)
    segments = camera.straight(matches.segments2d).reshape(-1, 2, 2)
    good: BoolArray = np.isfinite(points.sum(axis=1))
    good_lines: BoolArray = np.isfinite(segments.sum(axis=(1, 2)))
    moved = Matches(points[good], matches.points3d[good], segments[good_lines], matches.segments3d[good_lines])
    K = camera.matrix
    pinhole = {
        "model": "PINHOLE", "width": camera.width, "height": camera.height,
        "params": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
    }  # fmt: skip
    return Straight(pinhole, moved, good, good_lines)


def max_errors(matches: Matches) -> tuple[float, float]:
    """Return how far points, and ends of segments from their lines, may lie from where a proposed pose puts them."""
    factor = HYPOTHESES.slack * float(np.sqrt(chi_square_gate(NORMAL.outlier, 2)))
    sigmas = (matches.point_sigma, matches.segment_sigma)
    points, lines = (factor * float(np.median(sigma)) if len(sigma) else factor for sigma in sigmas)
    return points, lines


def propose(
    straight: Straight,
    errors: tuple[float, float],
    seed: int,
    share: float = 0.0,
    least: int = 0,
    min_trials: int = HYPOTHESES.min_trials,
) -> FloatArray | None:
    """Return the pose (7,) cam_from_world that most matches agree with; None without one.

    Parameters
    ----------
    straight
        Camera and matches without distortion.
    errors
        Of :func:`max_errors`, pixels.
    seed
        Of the samples.
    share
        A pose that a smaller share of the matches agrees with is of no interest, and need not be found.
    least
        Nor is one that fewer matches agree with.
    min_trials
        Samples drawn at least, however many matches agree with the first of them.
    """
    import poselib

    matches = straight.matches
    if matches.num_points + matches.num_lines < HYPOTHESES.min_matches:
        return None
    settings = {
        "max_reproj_error": errors[0], "max_epipolar_error": errors[1], "seed": seed,
        "success_prob": 1.0 - NORMAL.never, "min_iterations": min_trials,
        "max_iterations": _trials(share, min_trials),
    }  # fmt: skip
    ends, lines = matches.segments2d, matches.segments3d
    if matches.num_lines:
        found, report = poselib.estimate_absolute_pose_pnpl(
            matches.points2d, matches.points3d, ends[:, 0], ends[:, 1], lines[:, 0], lines[:, 1], straight.camera,
            settings, {},
        )  # fmt: skip
    else:
        found, report = poselib.estimate_absolute_pose(
            matches.points2d, matches.points3d, straight.camera, settings, {}
        )
    if report["num_inliers"] < max(HYPOTHESES.min_matches, least) or not np.isfinite(found.Rt).all():
        return None
    # The last digits depend on where arrays lie in memory; they are cut off, so that a seed gives one result.
    rotation = quaternion.from_matrix(np.asarray(found.R, np.float64)[None])[0].astype(np.float32).astype(np.float64)
    shift = np.asarray(found.t, np.float64).astype(np.float32).astype(np.float64)
    return np.concatenate([rotation / np.linalg.norm(rotation), shift])


def _trials(share: float, min_trials: int) -> int:
    """How many samples of three hold one without outliers, if so many matches are none; three times as many, since
    noise spoils some.
    """
    if share <= 0.0:
        return HYPOTHESES.max_trials
    wanted = 3.0 * np.log(NORMAL.never) / np.log1p(-(min(share, 0.99) ** 3))
    return int(np.clip(wanted, min_trials, HYPOTHESES.max_trials))
