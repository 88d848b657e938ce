# SPDX-License-Identifier: BSD-3-Clause
r"""How the right camera of a rectified pair is turned, estimated from a map, and the map corrected.

Rectification leaves up to a tenth of a degree about each axis. The rows of points found in both images tell pitch and
roll (:mod:`groma.tracking.frame.rectification`). Yaw shifts all disparities alike, and depths by
:math:`\delta z / z = -\delta / d`: a wrong scale, other for near points than for far ones. Motion tells the shape of
the scene without the pair, so near and far points together tell yaw: all keyframes and points are adjusted together
with a right camera that may turn, against a prior of what rectification leaves and what the rows tell.

Points that are followed agree to some extent with any yaw that was assumed when they were looked for. So described
features tell yaw first (:mod:`groma.tracking.backend.described_tracks`), and followed points, which are more precise,
once it is known so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from groma._typing import FloatArray
from groma.adjustment.assembly_options import RightTurnPrior
from groma.adjustment.terms.right_columns import RIGHT_CAMERAS
from groma.errors import ProblemError
from groma.geometry import quaternion, se3, so3
from groma.scene import Lines
from groma.solver.covariance.clusters import clustered
from groma.solver.covariance.marginals import Covariances
from groma.tracking.backend.described_tracks import described_tracks
from groma.tracking.backend.local_adjustment import AdjustmentJob, job_of
from groma.tracking.frame.camera import TrackCamera, back, into
from groma.tracking.frame.features import grid_pixels
from groma.tracking.frame.measurements import LineMeasurements
from groma.tracking.frame.rectification import (
    RightTurn,
    cells_of,
    fit_rows,
    retargeted,
    retargeted_depths,
    retargeted_ends,
    turned_pixels,
)
from groma.tracking.gates import RectificationGates
from groma.tracking.map.map_scene import TRACKING
from groma.tracking.map.track_map import Keyframe, TrackMap
from groma.tracking.options import TrackOptions

#: Of the increments of a right camera (the format of an increment).
YAW = 4


def estimate_turn(
    track_map: TrackMap, camera: TrackCamera, turn: RightTurn, options: TrackOptions
) -> tuple[RightTurn, AdjustmentJob | None]:
    """Return the rotation of the right camera, and the adjustment of the map that estimated it, if any.

    Parameters
    ----------
    track_map, camera
        A map, and the camera of its keyframes.
    turn
        By which the right images of the map were turned back.
    options
        Their gates hold the prior and the data that an estimate needs.
    """
    gates = options.gates.rectification
    known = RightTurn.unknown(gates).joined(*_rows_of(track_map, camera, turn, gates))
    living = track_map.living()
    if len(living) < gates.min_keyframes:
        return known, None
    if tells_yaw(camera, turn, gates) and _step(living) <= gates.max_step:
        found, job = _by_columns(track_map, camera, turn, known, gates, gates.min_views)
        if job is not None:
            return found, job
    described = described_tracks(track_map, camera, options.gates, options.point_sigma_px)
    return _by_columns(described, camera, turn, known, gates, 2)[0], None


def tells_yaw(camera: TrackCamera, turn: RightTurn, gates: RectificationGates) -> bool:
    """Whether yaw is known so well that the track need not restart for the remaining error."""
    return bool(camera.fx**2 * turn.covariance[1, 1] < gates.start_over**2)


def _by_columns(
    track_map: TrackMap, camera: TrackCamera, turn: RightTurn, known: RightTurn, gates: RectificationGates, views: int
) -> tuple[RightTurn, AdjustmentJob | None]:
    """Adjust a map together with the right camera; points seen by ``views`` keyframes take part."""
    living = track_map.living()
    held = np.arange(len(living)) == 0
    own = so3.exp(-turn.angles[None])[0]
    prior = RightTurnPrior(
        _log(own @ _exp(known.angles)), np.asarray(np.linalg.cholesky(np.linalg.inv(known.covariance)).T, np.float64)
    )
    options = replace(TRACKING, lines=False, planes=False, right_turn=prior)
    job = job_of(track_map, camera, living, held, False, gates.max_iterations, options, views)
    if job is None or np.isfinite(job.point_table.right[:, 0]).sum() < gates.min_columns:
        return known, None
    # Depths that features had where the map was lost are columns under the yaw that was assumed: they would keep it.
    job.scene = job.scene.replace(point_depths=job.scene.point_depths.take(np.zeros(0, np.int64)))
    job.function_tolerance = 1e-6
    job.solve()
    assert job.solved is not None
    try:
        covariances = Covariances(job.solved)
    except ProblemError:
        return known, None
    # The information of columns about yaw is reduced where their errors are correlated.
    before, after = known.covariance[1, 1], covariances.of(RIGHT_CAMERAS, 0)[0, YAW, YAW]
    information = 1.0 / after - 1.0 / before
    if not information > 0.0:
        return known, None
    yaw = _log(_exp(turn.angles) @ quaternion.to_matrix(job.solved.variables[RIGHT_CAMERAS].state[0, :4]))[1]
    own = (yaw / after - known.angles[1] / before) / information
    alike = _alike(job, camera, covariances, gates)
    return known.joined(np.array([0.0, own, 0.0]), np.diag([0.0, information / alike, 0.0])), job


def _step(keyframes: list[Keyframe]) -> float:
    """The usual distance from keyframe to keyframe, as a share of the depth: patches change their size by as much."""
    centers = se3.inverse(np.array([keyframe.pose for keyframe in keyframes]))[:, 4:]
    depth = np.array([keyframe.depth for keyframe in keyframes[1:]])
    return float(np.median(np.linalg.norm(np.diff(centers, axis=0), axis=1) / depth))


def _rows_of(
    track_map: TrackMap, camera: TrackCamera, turn: RightTurn, gates: RectificationGates
) -> tuple[FloatArray, FloatArray]:
    """Return the angles estimated from the rows of all pairs of a map, and their information."""
    tables = [keyframe.measured.points for keyframe in track_map.living()]
    left = np.concatenate([table.pixel for table in tables])
    right = np.concatenate([table.right for table in tables])
    found = np.isfinite(right[:, 0])
    return fit_rows(camera, left[found], turned_pixels(camera, right[found], _exp(turn.angles)), gates)


def _alike(job: AdjustmentJob, camera: TrackCamera, covariances: Covariances, gates: RectificationGates) -> float:
    """How much larger the variance of yaw is than if all errors were independent and of the stated noise.

    What a point errs goes together in all keyframes, and lens models err alike for neighbours: points whose places in
    the images have their middles in one cell are one sample.
    """
    landmark = np.searchsorted(job.points, job.point_table.index)
    middle = np.stack([np.bincount(landmark, weights=column) for column in job.point_table.pixel.T], axis=1)
    middle /= np.bincount(landmark)[:, None]
    cluster = np.unique(cells_of(camera, middle, gates), return_inverse=True)[1].ravel()
    independent = covariances.of(RIGHT_CAMERAS, 0)[0, YAW, YAW]
    return float(clustered(covariances, (RIGHT_CAMERAS, 0), "points", cluster)[YAW, YAW] / independent)


def shift_between(camera: TrackCamera, old: RightTurn, new: RightTurn) -> float:
    """Return by how much a pixel of the right image moves at most when one turn is taken for another."""
    corners = np.array([[x, y] for x in (0.0, 0.5, 1.0) for y in (0.0, 0.5, 1.0)]) * (camera.width, camera.height)
    shift = retargeted(camera, corners, old.angles, new.angles) - corners
    return float(np.abs(shift).max())


# -------------------------------------------------------------------------------------------------- correcting maps


def correct_map(
    track_map: TrackMap,
    camera: TrackCamera,
    old: RightTurn,
    new: RightTurn,
    options: TrackOptions,
    job: AdjustmentJob | None,
) -> None:
    """Correct the measurements of right images, which were rectified with other angles.

    Parameters
    ----------
    track_map, camera, options
        The map, its camera and options.
    old, new
        The angles, and those that are known better.
    job
        The adjustment of :func:`estimate_turn`, if it was of this map: its poses and points.
    """
    change = _Change(camera, old.angles, new.angles)
    _correct_points(track_map, change, job)
    rows, ends = _lines_in_cameras(track_map, change)
    if job is not None:
        # Old columns and lines, which are where these put them, are no judges.
        job.line_table = LineMeasurements.empty()
        job.point_table = replace(job.point_table, right=np.full_like(job.point_table.right, np.nan))
        job.apply(track_map)
    if len(rows):
        first = np.array([track_map.pose_of(int(k)) for k in track_map.lines.first_keyframe[rows]])
        ends = np.stack([se3.transform_points(se3.inverse(first), ends[:, k]) for k in (0, 1)], axis=1)
        moved = Lines.through(ends)
        track_map.lines.segment[rows], track_map.lines.plucker[rows] = moved.segments, moved.plucker
    for keyframe in track_map.keyframes:
        _correct_keyframe(keyframe, change, options)


@dataclass(frozen=True)
class _Change:
    """From one turn of the right camera to another."""

    camera: TrackCamera
    old: FloatArray
    new: FloatArray

    def stretch(self, in_cam: FloatArray) -> FloatArray:
        """Move points (N, 3) in a camera along their rays to where corrected disparities put them; NaN if nowhere."""
        pixels = self.camera.project(in_cam)
        depth = retargeted_depths(self.camera, pixels, in_cam[:, 2], self.old, self.new)
        return in_cam * (depth / in_cam[:, 2])[:, None]


def _correct_points(track_map: TrackMap, change: _Change, job: AdjustmentJob | None) -> None:
    """Move points that no adjustment moves, in the keyframes that saw them first."""
    points = track_map.points
    loose = points.alive.copy()
    if job is not None:
        loose[job.points] = False
    for index in np.unique(points.first_keyframe[loose]):
        pose = track_map.pose_of(int(index))
        rows = np.flatnonzero(loose & (points.first_keyframe == index))
        moved = change.stretch(into(pose, points.xyz[rows]))
        lost = np.isnan(moved[:, 0])
        points.xyz[rows[~lost]] = back(pose, moved[~lost])
        track_map.drop_points(rows[lost])


def _lines_in_cameras(track_map: TrackMap, change: _Change):
    """Corrected ends (n, 2, 3) of lines in the keyframes that saw them first, and their rows; drops those with none."""
    lines = track_map.lines
    rows = np.flatnonzero(lines.alive)
    if not len(rows):
        return rows, np.zeros((0, 2, 3))
    first = np.array([track_map.pose_of(int(k)) for k in lines.first_keyframe[rows]])
    ends = np.stack([change.stretch(se3.transform_points(first, lines.segment[rows, k])) for k in (0, 1)], axis=1)
    lost = np.isnan(ends).any(axis=(1, 2))
    track_map.drop_lines(rows[lost])
    return rows[~lost], ends[~lost]


def _correct_keyframe(keyframe: Keyframe, change: _Change, options: TrackOptions) -> None:
    camera, old, new = change.camera, change.old, change.new
    points, lines, features = keyframe.measured.points, keyframe.measured.lines, keyframe.features
    points = replace(
        points,
        right=retargeted(camera, points.right, old, new),
        depth=retargeted_depths(camera, points.pixel, points.depth, old, new),
    )
    lines = replace(lines, inverse_depth=retargeted_ends(camera, lines.ends, lines.inverse_depth, old, new))
    keyframe.measured = replace(keyframe.measured, points=points, lines=lines)
    keyframe.features = replace(features, depth=retargeted_depths(camera, features.pixel, features.depth, old, new))
    if len(keyframe.depth_grid):
        grid = grid_pixels(camera, options.gates.depth)
        keyframe.depth_grid = retargeted_depths(camera, grid, keyframe.depth_grid, old, new)


def _exp(angles: FloatArray) -> FloatArray:
    return so3.exp(angles[None])[0]


def _log(rotation: FloatArray) -> FloatArray:
    return so3.log(rotation[None])[0]
