# SPDX-License-Identifier: BSD-3-Clause
"""The tracker: frames in, poses out, and a map of points, lines and planes that grows.

::

    each frame      check it - predict - follow points and lines, assign planes - estimate the pose
                    if that fails: find the pose by described features, lines and planes
    now and then    make a keyframe - add landmarks - adjust the window - look for loops
    at the end      adjust all keyframes
"""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from groma._typing import FloatArray
from groma.errors import InputError
from groma.geometry import se3
from groma.io.sequences.frame import Frame, SequenceCamera
from groma.io.trajectories import Trajectory
from groma.scene import Scene
from groma.solver.report import SolveReport
from groma.tracking.camera import TrackCamera
from groma.tracking.checks import FrameChecks
from groma.tracking.features import FrameFeatures
from groma.tracking.following import carry, follow_frame
from groma.tracking.initialise import Initialiser
from groma.tracking.keyframes import Followed, add_keyframe, keyframe_nearby, wants_keyframe
from groma.tracking.local_adjustment import AdjustmentJob, job_of, window_job
from groma.tracking.loop_closure import LoopSearch, close_loop, search_for_loop
from groma.tracking.motion import PoseEstimate
from groma.tracking.options import TrackOptions
from groma.tracking.planes import merge_planes
from groma.tracking.points import find_again
from groma.tracking.prediction import MotionModel
from groma.tracking.relocalise import Found, find_pose
from groma.tracking.result import map_to_scene
from groma.tracking.stereo_calibration import correct_offset, estimate_offset
from groma.tracking.structure import find_lines_on_planes
from groma.tracking.track_map import Keyframe, TrackMap
from groma.tracking.upkeep import drop_repeating_keyframes, drop_unseen

#: What a frame can be.
TRACKED, FOUND, WEAK, LOST, SKIPPED, STARTING = "tracked", "found", "weak", "lost", "skipped", "starting"
#: A chosen frame becomes a keyframe, and the result of a window's adjustment is taken up, after this many frames.
DELAY = 2
#: Keyframes that are tried first, and at most, to find a lost frame.
NEAREST, MOST = 3, 30
#: Least number of agreeing measurements (a line counts twice, a plane six times), and least share.
LEAST_SCORE, LEAST_SHARE = 18.0, 0.35
#: Least number of agreeing points and lines (counted twice), where either is followed at all.
LEAST_EVIDENCE = 16.0


@dataclass(frozen=True)
class TrackedFrame:
    """What became of a frame."""

    timestamp: float
    #: (7,) cam_from_world; None where the frame has no pose.
    pose: FloatArray | None
    #: ``tracked``, ``found`` (again, by described features), ``weak`` (directions held by the prior alone), ``lost``,
    #: ``skipped`` (nothing to see, or out of order) or ``starting``.
    status: str
    #: Agreeing points, lines and planes.
    counts: dict[str, int]
    #: Seconds by stage.
    timings: dict[str, float]
    #: Directions that only the prior holds.
    weak: tuple[str, ...] = ()
    #: Why a frame was skipped.
    reason: str = ""
    keyframe: bool = False


@dataclass(frozen=True)
class TrackResult:
    """Outcome of a track."""

    #: Poses of all frames that have one, world_from_cam.
    trajectory: Trajectory
    #: Keyframes with points, lines and planes.
    scene: Scene
    #: Time stamps of the keyframes, in the order of the scene's images.
    keyframes: FloatArray
    statistics: dict
    warnings: tuple[str, ...] = ()


def _evidence(counts: dict[str, int]) -> float:
    """Weight of points and lines alone: planes slide along each other, so a pose should not hang on them."""
    return counts["points"] + 2.0 * counts["lines"]


@dataclass
class _Entry:
    """A tracked frame in terms of a keyframe, so that it moves when the keyframe is adjusted."""

    timestamp: float
    keyframe: int
    cam_from_keyframe: FloatArray


@dataclass
class _Chosen:
    """A frame chosen as a keyframe, with its pose in terms of a keyframe and what was followed in it."""

    data: FrameFeatures
    near: int
    relative: FloatArray
    followed: Followed
    age: int = 0

    def is_ready(self, delay: int) -> bool:
        """Whether frames have passed in which its features were found. Counted, so that runs repeat exactly."""
        self.age += 1
        return self.age >= delay


@dataclass
class _Pending:
    job: AdjustmentJob
    future: Future | None
    due: int
    frames: int = field(default=0)


class Tracker:
    """Track frames one by one.

    Parameters
    ----------
    camera
        The camera of all frames; free of distortion.
    options
        See :class:`TrackOptions`.
    """

    def __init__(self, camera: SequenceCamera, options: TrackOptions | None = None) -> None:
        self.options = options or TrackOptions()
        self.camera = TrackCamera.of(camera)
        self.map = TrackMap()
        self.status = STARTING
        self._checks = FrameChecks(self.camera)
        self._motion = MotionModel()
        self._initialiser: Initialiser | None = None
        self._data: FrameFeatures | None = None
        self._followed = Followed.nothing()
        self._pose = np.array([0, 0, 0, 1, 0, 0, 0.0])
        self._entries: list[_Entry] = []
        self._frames_since_keyframe = 0
        self._metric = True
        self._least_evidence = LEAST_EVIDENCE if self.options.points or self.options.lines else 0.0
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="groma-adjust") if self.options.threaded else None
        self._workers = ThreadPoolExecutor(2, thread_name_prefix="groma-detect") if self.options.threaded else None
        self._pending: _Pending | None = None
        self._search: tuple[LoopSearch, Future] | None = None
        self._statuses: dict[str, int] = {}
        self._seconds: dict[str, list[float]] = {}
        #: A frame that is to become a keyframe; its features are being found meanwhile.
        self._due: _Chosen | None = None
        self._lost_for = 0
        self._loops = 0
        self._finished = False

    # ------------------------------------------------------------------------------------------------- each frame

    def process(self, frame: Frame) -> TrackedFrame:
        """Track one frame; frames must come in order of time.

        Returns
        -------
        TrackedFrame
            Its pose and status. A frame that cannot be used is skipped and says why; only a frame of the wrong size or
            kind raises.

        Raises
        ------
        InputError
            If the frame does not have the size of the camera, or images of a wrong type.
        """
        if self._finished:
            raise InputError("This track is finished. Make a new Tracker for further frames.")
        began = time.perf_counter()
        watch = _Stopwatch()
        reason = self._checks.reason_to_skip(frame)
        if reason:
            return self._skip(frame, reason, began)
        data = FrameFeatures(frame, self.camera, self.options)
        with watch("take up"):
            self._take_up_adjustment()
        if self._due is not None and self._due.is_ready(DELAY if self._metric else 1):
            self._make_keyframe(watch)
        if not self.map.keyframes:
            return self._start(data, began, watch)
        predicted, prior_sigma = self._motion.predict(self._pose, frame.timestamp)
        estimate, doubtful, found = None, None, None
        status, followed = TRACKED, Followed.nothing()
        assert self._data is not None
        if self._lost_for == 0:
            estimate, followed = follow_frame(
                self.map, self.camera, self.options, self._data, data, self._followed, self._pose, predicted,
                prior_sigma, watch,
            )  # fmt: skip
            if not self._trustworthy(estimate, followed):
                doubtful, estimate = estimate, None
        if estimate is None:
            if self._lost_for == 0 and self._frames_since_keyframe > 0:
                # The frame before is the nearest there is to look for.
                if self._due is not None:
                    self._make_keyframe(watch)
                self._due = self._choose(self._data)
                self._make_keyframe(watch)
                predicted, prior_sigma = self._motion.predict(self._pose, frame.timestamp)
            with watch("find"):
                found = self._find(data, predicted, prior_sigma, doubtful)
            if found is None:
                return self._lose(data, began, watch)
            estimate, status = found.estimate, FOUND if self._lost_for else TRACKED
            followed = Followed(found.points, found.lines)
        pose = estimate.pose
        with watch("again"):
            followed = self._find_again(data, pose, followed)
        self._motion.update(self._pose if self._lost_for == 0 else None, pose, frame.timestamp)
        if estimate.weak and status == TRACKED:
            status = WEAK
        self._lost_for = 0
        self._pose, self._data, self._followed = pose, data, followed
        self._frames_since_keyframe += 1
        is_keyframe = False
        if self._due is None and (
            found is not None
            or (
                wants_keyframe(self.map, pose, followed, self._frames_since_keyframe, self.options)
                and not self._visit_nearby(data)
            )
        ):
            self._due = self._choose(data)
            is_keyframe = True
            if found is not None or self._workers is None:
                # What was found by features alone cannot be followed; the next frame needs this one's landmarks.
                self._make_keyframe(watch)
        return self._report(frame, status, estimate, is_keyframe, began, watch)

    def _trustworthy(self, estimate: PoseEstimate | None, followed: Followed) -> bool:
        """Whether enough agrees with a pose, and enough of what was followed."""
        if estimate is None:
            return False
        counts = estimate.counts
        score = counts["points"] + 2.0 * counts["lines"] + 6.0 * counts["planes"]
        looked_at = len(estimate.points) + len(estimate.lines)
        share = (counts["points"] + counts["lines"]) / looked_at if looked_at else 1.0
        last = self.map.near.measured
        before = len(last.points) + len(last.lines)
        kept = (counts["points"] + counts["lines"]) / max(before, 1)
        enough = score >= LEAST_SCORE and _evidence(counts) >= self._least_evidence
        return enough and share >= LEAST_SHARE and kept >= 0.12 and len(estimate.weak) < 6

    def _find(
        self, data: FrameFeatures, predicted: FloatArray, prior_sigma: FloatArray, doubtful: PoseEstimate | None
    ) -> Found | None:
        """Find a pose by described features: near the last keyframes first, then anywhere."""
        living = self.map.living()
        if self._lost_for == 0:
            nearest = living[::-1][:NEAREST]
            guesses = [predicted, self._pose] + ([doubtful.pose] if doubtful is not None else [])
            found = find_pose(self.map, self.camera, data, nearest, guesses, predicted, 3.0 * prior_sigma)
            if (
                found is not None
                and found.score >= LEAST_SCORE
                and _evidence(found.estimate.counts) >= 0.75 * self._least_evidence
                and len(found.estimate.weak) <= 2
            ):
                return found
        # Anywhere: recent keyframes and an even choice of the others.
        step = max(1, len(living) // MOST)
        anywhere = living[::-1][::step][:MOST]
        wide = np.array([1e3] * 3 + [10.0] * 3)
        best = None
        for keyframe in anywhere:
            found = find_pose(self.map, self.camera, data, [keyframe], [], keyframe.pose, wide)
            if found is not None and (best is None or found.score > best.score):
                best = found
            if best is not None and best.score > 120:
                break
        if best is not None and best.score >= 1.5 * LEAST_SCORE and not best.estimate.weak:
            return best
        return None

    def _find_again(self, data: FrameFeatures, pose: FloatArray, followed: Followed) -> Followed:
        """Look for points of the map that are in view but not followed."""
        room = self.options.num_points - len(followed.points)
        if not self.options.points or room < 0.2 * self.options.num_points:
            return followed
        found = find_again(self.map, self.camera, data.gray, pose, followed.points, room)
        return Followed(followed.points.joined(found), followed.lines)

    def _visit_nearby(self, data: FrameFeatures) -> bool:
        """Follow an older keyframe that stands for the present pose; return whether there is one, still seen well."""
        keyframe = keyframe_nearby(self.map, self._pose, self.options)
        if keyframe is None or self._pending is not None:
            return False
        self.map.visit(keyframe)
        points = self._followed.points
        found = find_again(self.map, self.camera, data.gray, self._pose, points, self.options.num_points)
        points = points.joined(found)
        seen = np.isin(keyframe.measured.points.index, points.index).sum()
        if seen < self.options.keyframe_share * len(keyframe.measured.points):
            return False
        self._followed = Followed(points, self._followed.lines)
        self._frames_since_keyframe = 0
        return True

    # -------------------------------------------------------------------------------------------------- keyframes

    def _start(self, data: FrameFeatures, began: float, watch: _Stopwatch) -> TrackedFrame:
        """Make the first keyframes: at once where depth is known, else from the motion between two frames."""
        if self._initialiser is None:
            self._initialiser = Initialiser(self.camera, self.options)
        with watch("start"):
            poses = self._initialiser.try_start(data)
            if poses is None:
                return self._report(data.frame, STARTING, None, False, began, watch)
            self._metric = self._initialiser.metric
            self._followed, self._pose = self._initialiser.make_map(self.map)
        self._data = data
        self._initialiser = None
        self._motion.update(None, self._pose, data.frame.timestamp)
        self._frames_since_keyframe = 0
        if len(self.map.keyframes) > 1:
            job = window_job(self.map, self.camera, self.options.window, False, self._metric)
            if job is not None:
                job.solve()
                self._apply(job)
        for keyframe in self.map.keyframes[:-1]:
            self._entries.append(_Entry(keyframe.timestamp, keyframe.index, se3.identity()))
        return self._report(data.frame, TRACKED, None, True, began, watch)

    def _choose(self, data: FrameFeatures) -> _Chosen:
        """Choose the present frame as a keyframe; its features are found in other threads meanwhile."""
        if self._workers is not None:
            data.prepare(self._workers)
        near = self.map.near
        relative = se3.compose(self._pose[None], se3.inverse(near.pose[None]))[0]
        return _Chosen(data, near.index, relative, self._followed)

    def _make_keyframe(self, watch: _Stopwatch) -> None:
        """Make a keyframe of the frame that was chosen."""
        assert self._due is not None
        chosen, self._due = self._due, None
        with watch("wait"):
            chosen.data.wait()
        with watch("take up"):
            self._take_up_adjustment(now=True)
        with watch("keyframe"):
            pose = se3.compose(chosen.relative[None], self.map.pose_of(chosen.near)[None])[0]
            followed = add_keyframe(self.map, self.camera, chosen.data, pose, chosen.followed, self.options)
            if chosen.data is self._data:
                self._followed = followed
            elif self._data is not None:
                self._followed = carry(
                    self.map, self.camera, chosen.data, self._data, followed, self._followed, self._pose
                )
            merge_planes(self.map.planes)
            if self.options.relations:
                find_lines_on_planes(self.map)
        self._frames_since_keyframe = 0
        with watch("adjust"):
            job = window_job(self.map, self.camera, self.options.window, self.options.relations, self._metric)
            if job is not None:
                if self._pool is None:
                    job.solve()
                    self._apply(job)
                else:
                    self._pending = _Pending(job, self._pool.submit(job.solve), DELAY)
        with watch("loop"):
            search = search_for_loop(self.map, self._metric) if self.options.close_loops else None
            if search is not None:
                if self._pool is None:
                    self._close_loop(search, search.run())
                elif self._search is None:
                    self._search = (search, self._pool.submit(search.run))
        with watch("upkeep"):
            drop_unseen(self.map)
            drop_repeating_keyframes(self.map, self._pending.job.keyframes if self._pending else [])

    def _take_up_adjustment(self, now: bool = False) -> None:
        """Take up the result of the thread when it is due."""
        if self._pending is not None:
            self._pending.due -= 1
            if self._pending.due > 0 and not now:
                return
            pending, self._pending = self._pending, None
            assert pending.future is not None
            pending.future.result()
            self._apply(pending.job)

        # Loops are closed between adjustments, which would undo them.
        if self._search is not None:
            (search, future), self._search = self._search, None
            self._close_loop(search, future.result())

    def _close_loop(self, search: LoopSearch, pairs: list) -> None:
        last = self.map.last
        before = last.pose.copy()
        if close_loop(self.map, self.camera, search.newest, pairs):
            self._loops += 1
            self._follow_world(se3.compose(se3.inverse(last.pose[None]), before[None])[0])

    def _apply(self, job: AdjustmentJob) -> None:
        self._follow_world(job.apply(self.map))

    def _follow_world(self, new_from_old: FloatArray) -> None:
        """Move the present pose with the map around the last keyframe."""
        self._pose = se3.compose(self._pose[None], se3.inverse(new_from_old[None]))[0]

    # ----------------------------------------------------------------------------------------------------- outcomes

    def _skip(self, frame: Frame, reason: str, began: float) -> TrackedFrame:
        self._statuses[SKIPPED] = self._statuses.get(SKIPPED, 0) + 1
        return TrackedFrame(
            frame.timestamp, None, SKIPPED, {}, {"total": time.perf_counter() - began}, reason=reason
        )  # fmt: skip

    def _lose(self, data: FrameFeatures, began: float, watch: _Stopwatch) -> TrackedFrame:
        self._lost_for += 1
        return self._report(data.frame, LOST, None, False, began, watch)

    def _report(self, frame, status, estimate, is_keyframe, began, watch) -> TrackedFrame:
        self.status = status
        self._statuses[status] = self._statuses.get(status, 0) + 1
        has_pose = status in (TRACKED, FOUND, WEAK)
        if has_pose:
            keyframe = self.map.near
            relative = se3.compose(self._pose[None], se3.inverse(keyframe.pose[None]))[0]
            self._entries.append(_Entry(frame.timestamp, keyframe.index, relative))
        timings = {**watch.seconds, "total": time.perf_counter() - began}
        for stage, seconds in timings.items():
            self._seconds.setdefault(stage, []).append(seconds)
        return TrackedFrame(
            frame.timestamp, self._pose.copy() if has_pose else None, status,
            estimate.counts if estimate is not None else {}, timings,
            estimate.weak if estimate is not None else (), keyframe=is_keyframe,
        )  # fmt: skip

    # ------------------------------------------------------------------------------------------------------ results

    def trajectory(self) -> Trajectory:
        """Return the poses of all tracked frames so far, as the keyframes stand now."""
        self._take_up_adjustment(now=True)
        if not self._entries:
            return Trajectory()
        poses = np.array([self.map.pose_of(entry.keyframe) for entry in self._entries])
        relative = np.array([entry.cam_from_keyframe for entry in self._entries]).reshape(-1, 7)
        world = se3.inverse(se3.compose(relative, poses))
        times = np.array([entry.timestamp for entry in self._entries])
        order = np.argsort(times, kind="stable")
        return Trajectory(times[order], world[order])

    def scene(self) -> Scene:
        """Return the keyframes with points, lines and planes as they stand now."""
        self._take_up_adjustment(now=True)
        return map_to_scene(self.map, self.camera)

    def finish(self) -> TrackResult:
        """End the track: adjust all keyframes together and return the result."""
        if self._due is not None:
            self._make_keyframe(_Stopwatch())
        self._take_up_adjustment(now=True)
        for pool in (self._pool, self._workers):
            if pool is not None:
                pool.shutdown(wait=True)
        self._pool = self._workers = None
        living = self.map.living()
        report, offset = None, 0.0
        if self.options.adjust_at_end and len(living) > 1:
            report = self._adjust_all(living)
            offset = estimate_offset(self.map, self.camera)
            if offset:
                correct_offset(self.map, self.camera, offset)
                report = self._adjust_all(living)
        self._finished = True
        warnings = list(self._checks.warnings)
        if not living:
            warnings.append("No map was made: no frame could be used, or the camera did not move enough to start.")
        return TrackResult(
            self.trajectory(), map_to_scene(self.map, self.camera),
            np.array([keyframe.timestamp for keyframe in living]), self.statistics(report, offset), tuple(warnings),
        )  # fmt: skip

    def _adjust_all(self, living: list[Keyframe]) -> SolveReport | None:
        """Adjust all keyframes together, twice: outliers are left out in between."""
        report = None
        held = np.zeros(len(living), dtype=bool)
        held[0] = True
        for _ in range(2):
            job = job_of(self.map, self.camera, living, held, self.options.relations, max_iterations=15)
            if job is not None:
                job.solve()
                job.apply(self.map)
                report = job.report
        return report

    def statistics(self, report: SolveReport | None = None, right_offset_px: float = 0.0) -> dict:
        """Return counts and times so far as plain numbers."""
        out: dict = {
            "frames": dict(self._statuses),
            "keyframes": len(self.map.living()),
            "points": int(self.map.points.alive.sum()),
            "lines": int(self.map.lines.alive.sum()),
            "planes": int(self.map.planes.alive.sum()),
            "loops": self._loops,
            "metric": self._metric,
            "milliseconds": {
                stage: {
                    "median": round(1e3 * float(np.median(seconds)), 3),
                    "p95": round(1e3 * float(np.percentile(seconds, 95)), 3),
                    "frames": len(seconds),
                }
                for stage, seconds in self._seconds.items()
            },
        }
        if right_offset_px:
            out["right_offset_px"] = right_offset_px
        if report is not None:
            out["final_adjustment"] = {"iterations": report.iterations, "seconds": dict(report.seconds)}
        return out


class _Stopwatch:
    """Seconds by stage; stages may repeat."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._stack: list[tuple[str, float]] = []

    def __call__(self, stage: str) -> _Stopwatch:
        self._stack.append((stage, time.perf_counter()))
        return self

    def __enter__(self) -> _Stopwatch:
        return self

    def __exit__(self, *error: object) -> None:
        stage, began = self._stack.pop()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - began


__all__ = ["FOUND", "LOST", "SKIPPED", "STARTING", "TRACKED", "WEAK", "TrackResult", "TrackedFrame", "Tracker"]
