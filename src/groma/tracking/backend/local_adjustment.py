# SPDX-License-Identifier: BSD-3-Clause
"""Adjust keyframes and what they see: a window with older keyframes held, or all of them at the end.

A job is prepared from the map, solved without access to the map (so in a thread, during tracking), and
applied to the map. Landmarks are eliminated; planes and poses remain in the reduced system.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.adjustment.assemble import assemble, first_camera_gauge
from groma.adjustment.assembly_options import AssemblyOptions
from groma.gates import NORMAL, SIGMA_OF_MEDIAN
from groma.geometry import se3
from groma.problem.problem import Problem
from groma.scene import Lines, Relations, Scene
from groma.solver.options import SolverOptions
from groma.solver.report import SolveReport
from groma.solver.solve import solve
from groma.tracking.frame.camera import TrackCamera, back, into
from groma.tracking.frame.measurements import LineMeasurements, PointMeasurements
from groma.tracking.map.lines import line_ends
from groma.tracking.map.map_scene import TRACKING, Seen, map_scene, stacked
from groma.tracking.map.relations import find_relations
from groma.tracking.map.track_map import Keyframe, TrackMap
from groma.tracking.pose.estimate import GATE

#: Keyframes outside the window that are held as its border.
BORDER = 8
#: A window is done where a step lowers its cost by less than this share: the next keyframe's goes on from there (cost:
#: iterations; noise alone moves the cost of a window by 2 %).
WINDOW_TOLERANCE = 0.01
#: Lower bound of the estimated noise of columns in right images, of the stated one.
LEAST_NOISE = 0.05


@dataclass
class AdjustmentJob:
    """Some keyframes with their landmarks, ready to be solved."""

    camera: TrackCamera
    keyframes: list[Keyframe]
    #: Which of them are held.
    held: BoolArray
    #: Landmarks of the map that take part.
    points: IntArray
    lines: IntArray
    planes: IntArray
    #: What takes part, as it was when the job was prepared, and how it is adjusted.
    scene: Scene
    options: AssemblyOptions
    #: Measurements of points and lines, with the keyframe (position in ``keyframes``) and the row in its table.
    point_table: PointMeasurements
    point_rows: IntArray
    point_pose: IntArray
    line_table: LineMeasurements
    line_rows: IntArray
    line_pose: IntArray
    max_iterations: int = 6
    function_tolerance: float = 1e-3
    report: SolveReport | None = None
    solved: Problem | None = field(default=None)

    def solve(self) -> None:
        """Make a problem of the scene and solve it; reads and changes nothing but this job."""
        options = SolverOptions(
            max_iterations=self.max_iterations, function_tolerance=self.function_tolerance, threads=1
        )
        solution = solve(assemble(self.scene, self.options).problem, options)
        self.solved, self.report = solution.problem, solution.report

    def apply(self, track_map: TrackMap) -> FloatArray:
        """Write the result to the map; return new_world_from_old_world (7,) near the newest keyframe."""
        assert self.solved is not None
        states = self.solved.variables
        poses = states["frames"].state
        old_last = self.keyframes[-1].pose.copy()
        loose = np.ones(len(track_map.points), dtype=bool)
        loose[self.points] = False
        for k in np.flatnonzero(~self.held):
            keyframe = self.keyframes[k]
            # Landmarks that only this keyframe sees go with it.
            rows = np.flatnonzero(loose & (track_map.points.first_keyframe == keyframe.index) & track_map.points.alive)
            track_map.points.xyz[rows] = back(poses[k], into(keyframe.pose, track_map.points.xyz[rows]))
            keyframe.pose = poses[k].copy()
        if "points" in states:
            track_map.points.xyz[self.points] = states["points"].state
        if "lines" in states:
            self._move_lines(track_map, states["lines"].ambient())
        if "planes" in states:
            hesse = states["planes"].ambient()
            track_map.planes.hesse[self.planes] = hesse / np.linalg.norm(hesse[:, :3], axis=1, keepdims=True)
        self._cull(track_map)
        return se3.compose(se3.inverse(self.keyframes[-1].pose[None]), old_last[None])[0]

    def _move_lines(self, track_map: TrackMap, plucker: FloatArray) -> None:
        good = np.isfinite(plucker).all(axis=1)
        rows = self.lines[good]
        every = Lines.through(track_map.lines.segment[rows]).moved_to(plucker[good])
        track_map.lines.plucker[rows] = every.plucker
        track_map.lines.segment[rows] = every.segments

    def _cull(self, track_map: TrackMap) -> None:
        """Forget measurements that do not agree, and landmarks that lost theirs."""
        points, lines = self.point_table, self.line_table
        poses = np.array([keyframe.pose for keyframe in self.keyframes])
        if len(points):
            at = se3.transform_points(poses[self.point_pose], track_map.points.xyz[points.index])
            away = np.linalg.norm(self.camera.project(at) - points.pixel, axis=1) / points.sigma
            wrong = ~(away < GATE * 1.2)
            self._forget_columns(at)
            self._forget("points", wrong, self.point_pose, self.point_rows)
            left = np.bincount(points.index[~wrong], minlength=len(track_map.points))
            track_map.drop_points(self.points[left[self.points] < 1])
        if len(lines):
            seen_from = poses[self.line_pose]
            ends, good = line_ends(self.camera, seen_from, track_map.lines.plucker[lines.index], lines.ends)
            pixels = [self.camera.project(se3.transform_points(seen_from, ends[:, side])) for side in (0, 1)]
            away = np.linalg.norm((np.hstack(pixels) - lines.ends).reshape(-1, 2, 2), axis=2).max(axis=1)
            wrong = ~(good & (away < GATE * 1.2 * lines.sigma + 1.0))
            self._forget("lines", wrong, self.line_pose, self.line_rows)
            left = np.bincount(lines.index[~wrong], minlength=len(track_map.lines))
            track_map.drop_lines(self.lines[left[self.lines] < 1])

    def _forget_columns(self, at: FloatArray) -> None:
        """Forget columns in right images that lie far from the others, as of points that are hidden there.

        Their noise is a fraction of that stated for points, so it is estimated from the columns themselves.
        """
        table = self.point_table
        found = np.flatnonzero(np.isfinite(table.right[:, 0]))
        if len(found) < NORMAL.sample:
            return
        column = self.camera.project(at[found] - [self.camera.baseline, 0.0, 0.0])[:, 0]
        error = np.abs(column - table.right[found, 0]) / table.sigma[found]
        limit = GATE * max(SIGMA_OF_MEDIAN * float(np.nanmedian(error)), LEAST_NOISE)
        wrong = found[~(error <= limit)]
        for k in np.unique(self.point_pose[wrong]):
            keyframe = self.keyframes[k]
            points = keyframe.measured.points
            right = points.right.copy()
            right[self.point_rows[wrong[self.point_pose[wrong] == k]]] = np.nan
            keyframe.measured = replace(keyframe.measured, points=replace(points, right=right))

    def _forget(self, kind: str, wrong: BoolArray, pose: IntArray, rows: IntArray) -> None:
        for k in np.unique(pose[wrong]):
            keyframe = self.keyframes[k]
            table = getattr(keyframe.measured, kind)
            keep = np.ones(len(table), dtype=bool)
            keep[rows[wrong & (pose == k)]] = False
            keyframe.measured = replace(keyframe.measured, **{kind: table.take(keep)})


def window_job(
    track_map: TrackMap, camera: TrackCamera, size: int, relations: bool, metric: bool
) -> AdjustmentJob | None:
    """Prepare the newest keyframe with those that share most with it; others that see the same are held."""
    living = track_map.living()
    if len(living) < 2:
        return None
    newest, others = living[-1], living[:-1]
    shared = track_map.shared(newest, others)
    recent = np.arange(len(others)) >= len(others) - 2
    order = np.argsort(-(shared + 10_000 * recent), kind="stable")
    chosen = [int(k) for k in order[: size - 1] if shared[k] >= 10 or recent[k]]
    window = [others[k] for k in sorted(chosen)] + [newest]
    inside = {keyframe.index for keyframe in window}
    outside = [keyframe for keyframe in others if keyframe.index not in inside]
    seen = np.zeros(len(track_map.points), dtype=bool)
    for keyframe in window:
        seen[keyframe.measured.points.index] = True
    common = np.array([int(seen[k.measured.points.index].sum()) for k in outside], dtype=np.int64)
    border = [outside[k] for k in np.argsort(-common, kind="stable")[:BORDER] if common[k] >= 8]
    held = np.array([True] * len(border) + [False] * len(window))
    if not border:
        held[0] = True
        if not metric and len(held) > 2:
            held[1] = True
    job = job_of(track_map, camera, border + window, held, relations)
    return job and replace(job, function_tolerance=WINDOW_TOLERANCE)


def job_of(
    track_map: TrackMap,
    camera: TrackCamera,
    keyframes: list[Keyframe],
    held: BoolArray,
    relations: bool,
    max_iterations: int = 6,
    options: AssemblyOptions = TRACKING,
    min_views: int = 2,
) -> AdjustmentJob | None:
    """Prepare the adjustment of some keyframes and all that at least two, or ``min_views``, of them see."""
    measured, pose, in_table = stacked(track_map, keyframes)
    points, lines = measured.points, measured.lines
    # Points seen once, or by no free keyframe, do not constrain poses.
    free = ~held
    often = np.bincount(points.index, minlength=len(track_map.points)) >= min_views
    moving = np.zeros(len(track_map.points), dtype=bool)
    moving[points.index[free[pose["points"]]]] = True
    keep = often[points.index] & moving[points.index]
    point_rows, points, point_pose = in_table["points"][keep], points.take(keep), pose["points"][keep]
    moving = np.zeros(len(track_map.lines), dtype=bool)
    moving[lines.index[free[pose["lines"]]]] = True
    known = np.bincount(lines.index, minlength=len(track_map.lines)) >= 2
    known[lines.index[np.isfinite(lines.inverse_depth).all(axis=1)]] = True
    keep = moving[lines.index] & known[lines.index]
    lines, line_pose, line_rows = lines.take(keep), pose["lines"][keep], in_table["lines"][keep]

    seen_points, seen_lines = Seen.of(points, point_pose), Seen.of(lines, line_pose)
    point_ids, line_ids = seen_points.ids, seen_lines.ids
    tied = np.concatenate([track_map.points.plane[point_ids], track_map.lines.plane[line_ids]])
    plane_ids = np.union1d(measured.planes.index, np.intersect1d(tied, np.flatnonzero(track_map.planes.of_landmarks)))
    scene = map_scene(
        camera,
        track_map,
        np.array([k.pose for k in keyframes]),
        [str(k.index) for k in keyframes],
        seen_points,
        seen_lines,
        Seen.of(measured.planes, pose["planes"], plane_ids),
        relations=find_relations(track_map, point_ids, line_ids, plane_ids) if relations else Relations(),
    )
    coordinates = held
    if held.sum() == 1 and len(scene.relations):
        # Distances between landmarks cost less in a smaller map: unless it is metric, its scale is held too.
        coordinates = first_camera_gauge(scene, first=int(held.argmax()))
    if not (len(points) or len(lines) or len(measured.planes)):
        return None
    return AdjustmentJob(
        camera, keyframes, held, point_ids, line_ids, plane_ids, scene, replace(options, held_frames=coordinates),
        points, point_rows, point_pose, lines, line_rows, line_pose, max_iterations,
    )  # fmt: skip
