# SPDX-License-Identifier: BSD-3-Clause
r"""The pose of one frame against a map that is held: points, lines and planes, each weighted by its noise.

A prior from constant velocity holds what the measurements do not determine. Which directions those are is told by the
eigenvectors of their information :math:`H = \sum w J^\top J`, scaled so that 1 means: known to 2 % of the median depth
(translation) or to 1 degree (rotation). A direction below 1 is *weak*.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.adjustment.pose_fit import (
    SeenMap,
    equations_at,
    fit_pose,
    line_rows,
    plane_rows,
    point_rows,
    seen_map,
    without_prior,
)
from groma.factors.losses import Cauchy, GemanMcClure, Loss
from groma.gates import NORMAL
from groma.tracking.frame.camera import TrackCamera, into
from groma.tracking.frame.measurements import Measurements
from groma.tracking.map.track_map import TrackMap

#: A residual beyond this many standard deviations is an outlier.
GATE = NORMAL.coordinate
#: What counts as a well-known direction: share of the median depth, and radians.
WEAK_SHARE, WEAK_ANGLE = 0.02, math.radians(1.0)
#: Losses, one after the other, under held landmarks.
LOSSES: tuple[Loss, ...] = (Cauchy(1.5), GemanMcClure(3.0))
_NAMES = ("x", "y", "z", "turn about x", "turn about y", "turn about z")


@dataclass(frozen=True)
class PoseEstimate:
    """A pose, what agrees with it, and how well it is known."""

    #: (7,) cam_from_world.
    pose: FloatArray
    #: Which measurements agree.
    points: BoolArray
    lines: BoolArray
    planes: BoolArray
    #: (6, 6) information of the measurements alone on the left twist (rho, omega).
    information: FloatArray
    #: Directions of the camera that only the prior holds, by the axis nearest to each.
    weak: tuple[str, ...]

    @property
    def counts(self) -> dict[str, int]:
        """Number of agreeing points, lines and planes."""
        return {"points": int(self.points.sum()), "lines": int(self.lines.sum()), "planes": int(self.planes.sum())}


def estimate_pose(
    camera: TrackCamera,
    view: TrackMap,
    measured: Measurements,
    predicted: FloatArray,
    prior_sigma: FloatArray,
    start: FloatArray | None = None,
    losses: Sequence[Loss] = LOSSES,
) -> PoseEstimate:
    """Estimate cam_from_world of one frame.

    Parameters
    ----------
    camera, view, measured
        The camera, the map, and what the frame measures of it (indices are those of the map).
    predicted : (7,)
        Prior pose.
    prior_sigma : (6,)
        Standard deviations of the prior: translation (scene units), rotation (radians).
    start : (7,), optional
        Where to start, if not at the prior.
    losses : sequence of Loss, optional
        Of the measurements, one after the other. From a :func:`rough_pose` the last one will do.
    """
    seen = _seen(camera, view, measured, predicted, prior_sigma)
    pose = predicted if start is None else start
    for loss in losses:
        pose = fit_pose(seen, pose, loss)
    alone = equations_at(without_prior(seen), pose, GemanMcClure(GATE))  # weights that fall for large residuals
    depth = _median_depth(view, measured, pose)
    points, lines, planes = (worst < GATE for worst in alone.worst)
    return PoseEstimate(pose, points, lines, planes, alone.H, weak_directions(alone.H, depth))


def rough_pose(
    camera: TrackCamera,
    view: TrackMap,
    measured: Measurements,
    predicted: FloatArray,
    prior_sigma: FloatArray,
    start: FloatArray,
) -> FloatArray:
    """Return a pose (7,) by measurements of which some are wrong, from where :func:`estimate_pose` may go on."""
    return fit_pose(_seen(camera, view, measured, predicted, prior_sigma), start, LOSSES[0])


def _seen(
    camera: TrackCamera, view: TrackMap, measured: Measurements, predicted: FloatArray, prior_sigma: FloatArray
) -> SeenMap:
    """Return what a frame measures of the map beside where that is."""
    points, lines, planes, K = measured.points, measured.lines, measured.planes, camera.params
    place = view.points.xyz[points.index]
    segments = lines.ends, lines.sigma, lines.inverse_depth, lines.inverse_depth_sigma
    return seen_map(
        K,
        (camera.baseline, camera.line_baseline),
        point_rows(place, points.pixel, points.sigma, points.right[:, 0], points.depth, points.depth_sigma),
        line_rows(view.lines.plucker[lines.index], *segments, K, camera.line_baseline),
        plane_rows(view.planes.hesse[planes.index], planes.plane, planes.sqrt_information),
        predicted,
        prior_sigma,
    )


def weak_directions(information: FloatArray, depth: float) -> tuple[str, ...]:
    """Name the directions of a pose that are known worse than the limits."""
    unit = np.array([WEAK_SHARE * depth] * 3 + [WEAK_ANGLE] * 3)
    values, vectors = np.linalg.eigh(unit[:, None] * information * unit)
    return tuple(_NAMES[int(np.abs(vectors[:, k]).argmax())] for k in range(6) if values[k] < 1.0)


def _median_depth(view: TrackMap, measured: Measurements, pose: FloatArray) -> float:
    places = [view.points.xyz[measured.points.index], view.lines.segment[measured.lines.index].mean(axis=1)]
    depths = into(pose, np.concatenate(places))[:, 2]
    depths = depths[depths > 0]
    return float(np.median(depths)) if len(depths) else 1.0
