# SPDX-License-Identifier: BSD-3-Clause
r"""The offset of the inverse depths of a depth camera, estimated from a map, and the map corrected.

A depth camera measures a disparity; a constant error of it is one of inverse depths,

.. math:: \frac1z = \frac1{\tilde z} + c ,

and an error of depths that grows with the depth. A moving camera sees the same from far and near, so the map determines
the offset c: the cost of all measurements, minimised over poses and landmarks, is a function of c alone. Its slope at
the minimum is that of the depths alone, with poses and landmarks held; c is where the slope vanishes, between two
solved maps. (A common factor of all depths is the scale of the map, which images do not determine.)

Errors within one image are correlated: its depths, planes and segments come from the same disparities. The samples are
therefore images, not depths, and the variance is inflated by the spread of their slopes. With the prior (the offset is
about as large as the noise of a single depth) this gives the posterior mean, which is close to zero where the map
determines the offset poorly. An offset far larger than the noise has another cause, a focal length perhaps, and is not
applied.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from groma._typing import FloatArray
from groma.adjustment.assemble import assemble
from groma.gates import NORMAL, SIGMA_OF_MEDIAN
from groma.geometry import se3
from groma.problem.problem import Problem
from groma.problem.residuals import squared_norms
from groma.solver.options import SolverOptions
from groma.solver.solve import solve
from groma.tracking.backend.local_adjustment import job_of
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.gates import DepthGates
from groma.tracking.map.map_scene import stacked
from groma.tracking.map.track_map import Keyframe, TrackMap
from groma.tracking.options import TrackOptions

#: Step of the differences of costs, of the deviation known beforehand.
_STEP = 0.05


@dataclass(frozen=True)
class DepthOffset:
    """What is added to inverse depths, one over scene units, and how well it is known."""

    offset: float
    sigma: float
    #: Whether the map was corrected by it: it is no larger than such errors are.
    used: bool

    def numbers(self) -> dict[str, float | bool]:
        """Return it as plain values."""
        return {"inverse_offset": self.offset, "sigma": self.sigma, "used": self.used}

    def warnings(self) -> list[str]:
        """Say so where depths and images do not agree."""
        if self.used:
            return []
        return [
            f"Depths and images disagree: inverse depths would have to be off by {self.offset:+.4f} ± {self.sigma:.4f} "
            "per metre, more than those of depth cameras are; they were left as they are. Check the focal length, and "
            "that depths belong to the pixels of the images."
        ]


def estimate_depth_offset(track_map: TrackMap, camera: TrackCamera, options: TrackOptions) -> DepthOffset | None:
    """Return the offset of the inverse depths of a map; None without depths.

    What is known beforehand is that the common error is no larger than the noise of a single depth.
    """
    prior, count = options.gates.depth.inverse_sigma, len(track_map.living())
    if count < options.gates.depth.min_images or not has_depths(track_map):
        return None
    maps = _Maps(track_map, camera, options)
    settled = maps.solved(0.0, None)
    slope = maps.slopes(0.0, settled).sum()
    # One step of the size of the prior gives the curvature, a second one the zero of the slope.
    first = -math.copysign(prior, slope)
    there = maps.solved(first, settled)
    curvature = (maps.slopes(first, there).sum() - slope) / first
    if not curvature > 0.0:
        return None
    least = -slope / curvature
    there = maps.solved(least, there)
    slopes, alone = maps.slopes(least, there), maps.curvature(least, there)
    alike = max(float(count / (count - 1) * (slopes**2).sum()) / max(alone, 1e-300), 1.0)
    information = curvature / alike
    total = information + 1.0 / prior**2
    offset = least * information / total
    used = abs(offset) < NORMAL.far * prior
    return DepthOffset(float(offset), float(total**-0.5), bool(used))


def has_depths(track_map: TrackMap) -> bool:
    """Whether keyframes measured depths themselves."""
    return any(np.isfinite(keyframe.measured.points.depth).any() for keyframe in track_map.living())


def depths_that_do_not_fit(track_map: TrackMap, gates: DepthGates) -> list[str]:
    """Say so where the depths of points are far from where three and more images have the points of a map.

    The median deviation tells: depths beside edges, up to a tenth of all, are off in good sequences, too.
    """
    living, points = track_map.living(), track_map.points
    measured, image, _ = stacked(track_map, living)
    table, poses = measured.points, np.array([keyframe.pose for keyframe in living])
    seen = np.bincount(table.index, minlength=len(points))
    told = np.flatnonzero(np.isfinite(table.depth) & (seen[table.index] >= 3))
    depth = se3.transform_points(poses[image["points"][told]], points.xyz[table.index[told]])[:, 2]
    every = np.abs(depth - table.depth[told]) / table.depth_sigma[told]
    median = float(np.median(every)) if len(every) >= NORMAL.sample else 0.0
    if SIGMA_OF_MEDIAN * median <= gates.max_misfit:
        return []
    return [
        f"Depths and images disagree: half of the depths are more than {median:.1f} standard deviations from where the "
        f"images have their points ({1.0 / SIGMA_OF_MEDIAN:.1f} expected). Check that depths belong to the pixels of "
        "the images, and are of the same time."
    ]


class _Maps:
    """A map with depths corrected by several offsets."""

    def __init__(self, track_map: TrackMap, camera: TrackCamera, options: TrackOptions) -> None:
        self._map, self._camera, self._options = track_map, camera, options

    def problem(self, offset: float, at: Problem | None) -> Problem:
        """Return the adjustment of all keyframes with an offset, at the states of another one."""
        moved = self._map.copy()
        correct_depths(moved, offset)
        living = moved.living()
        job = job_of(moved, self._camera, living, np.arange(len(living)) == 0, self._options.relations)
        assert job is not None
        problem = assemble(job.scene, job.options).problem
        return problem if at is None else Problem(at.variables, problem.factors)

    def solved(self, offset: float, near: Problem | None) -> Problem:
        """Return the same, solved."""
        settings = SolverOptions(max_iterations=60, function_tolerance=1e-7, threads=1)
        return solve(self.problem(offset, near), settings).problem

    def slopes(self, offset: float, solved: Problem) -> FloatArray:
        """Return how the cost of each image (K,) changes with the offset, poses and landmarks held."""
        step = _STEP * self._options.gates.depth.inverse_sigma
        more, less = (_costs(self.problem(offset + sign * step, solved)) for sign in (1.0, -1.0))
        return (more - less) / (2.0 * step)

    def curvature(self, offset: float, solved: Problem) -> float:
        """Return how the slope changes with the offset, poses and landmarks held."""
        step = self._options.gates.depth.inverse_sigma
        more, less = (self.slopes(offset + sign * step, solved).sum() for sign in (0.5, -0.5))
        return float(more - less) / step


def _costs(problem: Problem) -> FloatArray:
    """Costs (K,) of what each image measured."""
    frames = len(problem.variables["frames"])
    total = np.zeros(frames)
    for factor in problem.factors:
        image = next((ref.index for slot, ref in factor.references() if slot.name == "pose"), None)
        if image is not None:
            cost = 0.5 * factor.loss.evaluate(squared_norms(factor, problem.variables))[0]
            total += np.bincount(image, weights=cost, minlength=frames)
    return total


def correct_depths(track_map: TrackMap, offset: float) -> None:
    """Add an offset to all inverse depths that the keyframes of a map measured; landmarks and poses stay."""
    for keyframe in track_map.keyframes:
        _correct(keyframe, offset)


def _correct(keyframe: Keyframe, offset: float) -> None:
    points, lines, planes = keyframe.measured.points, keyframe.measured.lines, keyframe.measured.planes
    depth = _corrected(points.depth, offset)
    points = replace(points, depth=depth, depth_sigma=points.depth_sigma * (depth / points.depth) ** 2)
    lines = replace(lines, inverse_depth=lines.inverse_depth + offset)
    if len(planes):
        # A plane n . X + w = 0 has the inverse depth -n/w . (x, y, 1).
        plane = planes.plane.copy()
        plane[:, 2] -= offset * plane[:, 3]
        planes = replace(planes, plane=plane / np.linalg.norm(plane[:, :3], axis=1, keepdims=True))
    keyframe.measured = replace(keyframe.measured, points=points, lines=lines, planes=planes)
    keyframe.features = replace(keyframe.features, depth=_corrected(keyframe.features.depth, offset))
    keyframe.depth_grid = _corrected(keyframe.depth_grid, offset)


def _corrected(depth: FloatArray, offset: float) -> FloatArray:
    """Depths (...) with an offset of their inverse; NaN where none is left."""
    with np.errstate(invalid="ignore", divide="ignore"):
        inverse = 1.0 / depth + offset
        return np.where(inverse > 0.0, 1.0 / inverse, np.nan)
