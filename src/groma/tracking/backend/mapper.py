# SPDX-License-Identifier: BSD-3-Clause
"""Work between frames: keyframes, adjustment of windows, and loops, partly in other threads."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from groma._stopwatch import Stopwatch
from groma._typing import FloatArray
from groma.geometry import se3
from groma.solver.report import SolveReport
from groma.tracking.backend.depth_calibration import DepthOffset, correct_depths, estimate_depth_offset
from groma.tracking.backend.local_adjustment import AdjustmentJob, job_of, window_job
from groma.tracking.backend.loop_closure import LoopSearch, search_for_loop
from groma.tracking.backend.metric_loops import close_loop
from groma.tracking.backend.plane_outcome import PlaneOutcome, drop_what_failed
from groma.tracking.backend.scaled_loops import close_scaled_loops
from groma.tracking.backend.stereo_calibration import correct_map, estimate_turn, shift_between, tells_yaw
from groma.tracking.backend.submaps import Joint, find_joint, search_older_maps
from groma.tracking.beside import beside
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.frame.features import FrameFeatures
from groma.tracking.frame.rectification import RightCamera, RightTurn
from groma.tracking.map.culling import drop_repeating_keyframes, drop_unseen
from groma.tracking.map.keyframes import Followed, add_keyframe
from groma.tracking.map.landmark_planes import find_planes
from groma.tracking.map.planes import merge_planes
from groma.tracking.map.relations import find_lines_on_planes
from groma.tracking.map.track_map import TrackMap
from groma.tracking.options import TrackOptions
from groma.tracking.pose.following import carry, find_points_again
from groma.tracking.result import map_to_scene


@dataclass
class Present:
    """The last tracked frame: its pose and tracked features."""

    data: FrameFeatures | None = None
    pose: FloatArray = field(default_factory=se3.identity)
    followed: Followed = field(default_factory=Followed.nothing)
    frames_since_keyframe: int = 0


@dataclass
class _Chosen:
    """A frame chosen as a keyframe, with its pose relative to a keyframe and its tracked features."""

    data: FrameFeatures
    near: int
    relative: FloatArray
    followed: Followed
    age: int = 0

    def is_ready(self, now: float, delay: int, seconds: float) -> bool:
        """Whether ``delay`` frames and some seconds of their time stamps have passed, in which features are computed.

        No other clock is used, so that runs are reproducible.
        """
        self.age += 1
        return self.age >= delay and now - self.data.frame.timestamp >= seconds


@dataclass
class _Pending:
    job: AdjustmentJob
    finish: Callable[[], None]
    due: int


class Mapper:
    """Makes keyframes of chosen frames and keeps the map adjusted."""

    def __init__(
        self,
        camera: TrackCamera,
        options: TrackOptions,
        right_turn: RightTurn | None = None,
        first: TrackMap | None = None,
    ) -> None:
        #: Submaps; more than one after the track was lost for long. The first may be of an earlier track.
        self.maps, self.current = [first or TrackMap()], 0
        #: Joints to older submaps, by the number of the newer one.
        self.joints: dict[int, Joint] = {}
        self.camera, self.options = camera, options
        #: The right camera of stereo pairs, and the number of keyframes at which its rotation is estimated next.
        self.right = RightCamera(camera, options.gates.rectification, options.gates.features, right_turn)
        self._next_look = options.gates.rectification.min_keyframes
        #: The rotation assumed for the first keyframes, and whether the track may still restart.
        self._began_with, self._may_begin_anew = right_turn, right_turn is None
        #: The rotation of the right camera, if the assumed one is so far off that the track should restart.
        self.better_turn: RightTurn | None = None
        self.metric = first is None or first.is_metric
        #: Offset of the inverse depths of a depth camera. Maps of earlier tracks are corrected already.
        self.depth_offset: DepthOffset | None = None
        self._begun_here = first is None
        self.loops = 0
        #: A frame that is to become a keyframe; its features are being computed.
        self.due: _Chosen | None = None
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="groma-adjust") if options.threaded else None
        self.workers = ThreadPoolExecutor(2, thread_name_prefix="groma-detect") if options.threaded else None
        #: For the work of frames, which must not wait for keyframes.
        self.frame_pool = ThreadPoolExecutor(1, thread_name_prefix="groma-frame") if options.threaded else None
        self._pending: _Pending | None = None
        self._search: tuple[LoopSearch, Callable[[], list]] | None = None

    @property
    def map(self) -> TrackMap:
        """The current submap."""
        return self.maps[self.current]

    def numbers(self) -> dict:
        """Counts of the current submap, and the number of submaps, as plain numbers."""
        return {
            "keyframes": len(self.map.living()),
            "points": int(self.map.points.alive.sum()),
            "lines": int(self.map.lines.alive.sum()),
            "planes": int(self.map.planes.alive.sum()),
            "loops": self.loops,
            "maps": max(sum(bool(submap.keyframes) for submap in self.maps), 1),
            "maps_joined": len(self.joints),
            "metric": self.metric,
            **({} if self.depth_offset is None else {"depth_camera": self.depth_offset.numbers()}),
        }

    def begin_anew(self, present: Present) -> None:
        """Leave the current map and start another."""
        self.leave(present)
        if self.maps[-1].keyframes:
            self.maps.append(TrackMap())
        self.current = len(self.maps) - 1

    def leave(self, present: Present) -> None:
        """Finish pending work on the current submap."""
        self.due = None
        self.take_up(present, now=True)

    @property
    def threaded(self) -> bool:
        """Whether features are computed in other threads."""
        return self.workers is not None

    @property
    def busy(self) -> bool:
        """Whether a window is being adjusted."""
        return self._pending is not None

    def advance(self, present: Present, at_once: bool = False) -> Stopwatch:
        """Apply due results and make the due keyframe between two frames, or one of the current frame at once.

        Returns the timings.
        """
        watch = Stopwatch()
        if at_once:
            assert present.data is not None
            with watch("again"):
                present.followed = find_points_again(self.map, present.data, present.pose, present.followed)
            self.choose(present, present.data)
            self.make_keyframe(present, watch)
        with watch("take up"):
            self.take_up(present)
        if self.due is not None and present.data is not None:
            gates, now = self.options.gates.keyframes, present.data.frame.timestamp
            # In a monocular track points are triangulated from keyframes alone.
            if self.due.is_ready(now, *((gates.delay, gates.delay_seconds) if self.metric else (1, 0.0))):
                self.make_keyframe(present, watch)
        return watch

    def adjust_start(self, present: Present) -> None:
        """Adjust the first keyframes of a monocular track."""
        job = window_job(self.map, self.camera, self.options.window, False, self.metric)
        if job is not None:
            job.solve()
            self.apply(present, job)

    def choose(self, present: Present, data: FrameFeatures) -> None:
        """Choose the current frame as a keyframe; its features are computed in other threads."""
        data.keep_up()
        if self.workers is not None:
            data.prepare(self.workers)
        near = self.map.near
        relative = se3.compose(present.pose[None], se3.inverse(near.pose[None]))[0]
        self.due = _Chosen(data, near.index, relative, present.followed)

    def keep_present(self, present: Present, watch: Stopwatch) -> None:
        """Make a keyframe of the current frame, unless it is one, and apply all pending results.

        A relocalised keyframe whose window is not adjusted yet would mislead the next one.
        """
        if self.due is not None:
            self.make_keyframe(present, watch)
        if present.frames_since_keyframe > 0:
            assert present.data is not None
            self.choose(present, present.data)
            self.make_keyframe(present, watch)
        else:
            with watch("take up"):
                self.take_up(present, now=True)

    def make_keyframe(self, present: Present, watch: Stopwatch) -> None:
        """Make a keyframe of the chosen frame."""
        assert self.due is not None
        chosen, self.due = self.due, None
        with watch("features"):
            chosen.data.wait()
        with watch("take up"):
            self.take_up(present, now=True)
        with watch("keyframe"):
            pose = se3.compose(chosen.relative[None], self.map.pose_of(chosen.near)[None])[0]
            followed = add_keyframe(self.map, chosen.data, pose, chosen.followed)
            if chosen.data is present.data:
                present.followed = followed
            elif present.data is not None:
                present.followed = carry(
                    self.map, self.camera, chosen.data, present.data, followed, present.followed, present.pose,
                    self.frame_pool,
                )  # fmt: skip
            merge_planes(self.map.planes, self.options.gates.planes)
            if self.options.relations:
                find_lines_on_planes(self.map)
        present.frames_since_keyframe = max(chosen.age - 1, 0)
        with watch("right camera"):
            self._look_at_right_camera(present)
        with watch("adjust"):
            job = window_job(self.map, self.camera, self.options.window, self.options.relations, self.metric)
            if job is not None:
                self._pending = _Pending(job, beside(self._pool, job.solve), self.options.gates.keyframes.delay)
        with watch("loop"):
            search = self._what_to_search() if self.options.close_loops else None
            if search is not None and self._search is None:
                self._search = (search, beside(self.workers, search.run))
        with watch("culling"):
            drop_unseen(self.map, self.options.gates.points.max_misses)
            busy = self._pending.job.keyframes if self._pending else []
            drop_repeating_keyframes(self.map, busy, self.options.gates.culling)

    def take_up(self, present: Present, now: bool = False) -> None:
        """Apply the result of the adjustment when it is due, then that of the loop search."""
        if self._pending is not None:
            self._pending.due -= 1
            if self._pending.due > 0 and not now:
                return
            pending, self._pending = self._pending, None
            pending.finish()
            self.apply(present, pending.job)

        # Loops are closed between adjustments, whose results would undo them.
        if self._search is not None:
            (search, found), self._search = self._search, None
            self._close_loop(present, search, found())

    def _what_to_search(self) -> LoopSearch | None:
        """Search the older submaps until this one is joined to one of them, then this submap for loops."""
        newest = len(self.maps) - 1
        if 0 < newest == self.current and newest not in self.joints:
            return search_older_maps(self.maps, self.map.last, self.options.gates)
        # Loops of a monocular track are closed at the end, since its scale changes then.
        return search_for_loop(self.map, self.map.last, self.options.gates, self.camera) if self.metric else None

    def _close_loop(self, present: Present, search: LoopSearch, pairs: list) -> None:
        if search.newest is not self.map.keyframes[search.newest.index]:
            return
        if pairs and not any(pair[0] in self.map.living() for pair in pairs):
            joint = find_joint(self.maps, self.camera, self.current, search.newest, pairs, self.options)
            if joint is not None:
                self.joints[self.current] = joint
                self.map.pinned.add(joint.newest)
                self.maps[joint.older].pinned.add(joint.keyframe)
            return
        last = self.map.last
        before = last.pose.copy()
        if close_loop(self.map, self.camera, search.newest, pairs, self.options):
            self.loops += 1
            _follow_world(present, se3.compose(se3.inverse(last.pose[None]), before[None])[0])

    def apply(self, present: Present, job: AdjustmentJob) -> None:
        """Apply the result of an adjustment."""
        _follow_world(present, job.apply(self.map))

    def _look_at_right_camera(self, present: Present) -> None:
        """Estimate the rotation of the right camera from time to time; correct the maps if it was assumed wrongly."""
        gates, living = self.options.gates.rectification, self.map.living()
        if not self.camera.baseline > 0 or len(living) < self._next_look:
            return
        self._next_look = math.ceil(gates.growth * len(living))
        self._began_with = self._began_with or self.right.turn
        turn, job = estimate_turn(self.map, self.camera, self.right.turn, self.options)
        if not turn.is_as_sure_as(self.right.turn, gates):
            return
        if self._may_begin_anew and tells_yaw(self.camera, turn, gates):
            self._may_begin_anew = False
            if shift_between(self.camera, self._began_with, turn) > gates.start_over:
                self.better_turn = turn
        if shift_between(self.camera, self.right.turn, turn) > gates.matters:
            last = self.map.last
            before = last.pose.copy()
            for track_map in self.maps:
                correct_map(
                    track_map, self.camera, self.right.turn, turn, self.options, job if track_map is self.map else None
                )
            self.right.turn = turn
            self._adjust_all()
            _follow_world(present, se3.compose(se3.inverse(last.pose[None]), before[None])[0])
        else:
            self.right.turn = replace(self.right.turn, covariance=turn.covariance)

    def _adjust_all(self) -> SolveReport | None:
        """Adjust all keyframes of the map together, twice: outliers are left out in between."""
        report, living = None, self.map.living()
        if len(living) < 2:
            return None
        held = np.zeros(len(living), dtype=bool)
        held[0] = True
        most = self.options.gates.loops.final_iterations
        for _ in range(2):
            job = job_of(self.map, self.camera, living, held, self.options.relations, most)
            if job is not None:
                job.solve()
                job.apply(self.map)
                report = job.report
        return report

    def abandon(self) -> None:
        """Drop pending work."""
        self.due = self._pending = self._search = None

    def close(self) -> None:
        """End the threads."""
        pools = self._pool, self.workers, self.frame_pool
        self._pool = self.workers = self.frame_pool = None
        for pool in pools:
            if pool is not None:
                pool.shutdown(wait=True, cancel_futures=True)

    def close_scaled_loops(self, number: int) -> None:
        """Close the loops of a monocular map."""
        self.loops += close_scaled_loops(self.maps[number], self.camera, self.options)

    def adjust_at_end(self, number: int) -> tuple[SolveReport | None, RightTurn]:
        """Adjust all keyframes of a map together; return the report and the rotation of the right camera.

        Errors of that rotation, or of depths, are estimated and corrected first.
        """
        self.current = number
        turn = self.right.turn
        if len(self.map.living()) < 2:
            return None, turn
        report = self._adjust_all()
        if self.camera.baseline > 0:
            found, job = estimate_turn(self.map, self.camera, self.right.turn, self.options)
            turn = found if found.is_as_sure_as(turn, self.options.gates.rectification) else turn
            if shift_between(self.camera, self.right.turn, turn) > self.options.gates.rectification.matters:
                correct_map(self.map, self.camera, self.right.turn, turn, self.options, job)
                report = self._adjust_all()
            turn = turn.confirming(self._began_with or turn)
        elif self._begun_here:
            self.depth_offset = estimate_depth_offset(self.map, self.camera, self.options)
            if self.depth_offset is not None and self.depth_offset.used:
                correct_depths(self.map, self.depth_offset.offset)
                report = self._adjust_all()
        return report, turn

    def adjust_with_planes(self, number: int) -> tuple[SolveReport | None, PlaneOutcome | None]:
        """Find planes in the points and lines of a map, and adjust all keyframes with them; those that fail go.

        Depth images show planes themselves: where they did, nothing is done.
        """
        self.current = number
        track_map, options, gates = self.map, self.options, self.options.gates.landmark_planes
        wanted = options.planes and options.relations
        if not wanted or (track_map.planes.found > 0).any() or len(track_map.living()) < 2:
            return None, None
        scene = map_to_scene(track_map, self.camera, min_views=1)
        searched = scene.num_points, scene.num_lines
        once = int((np.bincount(scene.point_observations.point_idx, minlength=scene.num_points) == 1).sum())
        found = find_planes(track_map, scene, gates)
        if not found:
            return None, PlaneOutcome(searched, once, 0, 0)
        report = self._adjust_all()
        dropped, gone = drop_what_failed(track_map, self.camera, gates)
        if dropped or gone:
            report = self._adjust_all()
        points, lines = (int((table.alive & (table.plane >= 0)).sum()) for table in (track_map.points, track_map.lines))
        return report, PlaneOutcome(searched, once, found, found - gone, points, lines, dropped)


def _follow_world(present: Present, new_from_old: FloatArray) -> None:
    """Move the present pose with the map around the last keyframe."""
    present.pose = se3.compose(present.pose[None], se3.inverse(new_from_old[None]))[0]
