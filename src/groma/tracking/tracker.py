# SPDX-License-Identifier: BSD-3-Clause
"""The tracker: frames in, poses out, and a map of points, lines and planes that grows.

::

    each frame            check it - predict - follow points and lines, assign planes - estimate the pose
                          if that fails: find the pose by described features, lines and planes
    behind the answer     now and then: make a keyframe - add landmarks - adjust the window - look for loops
    at the end            adjust all keyframes
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np

from groma._stopwatch import Stopwatch
from groma._typing import FloatArray
from groma.errors import InputError, check_kind, given_or_default
from groma.execution import work_with
from groma.geometry import se3
from groma.io.sequences.frame import Frame, SequenceCamera
from groma.io.trajectories import Trajectory
from groma.scene import Scene
from groma.tracking.backend.deferred import DeferredTask
from groma.tracking.backend.mapper import Mapper, Present
from groma.tracking.backend.submaps import about_submaps
from groma.tracking.ending import Ending
from groma.tracking.frame.ahead import LookAhead
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.frame.checks import FrameChecks
from groma.tracking.frame.coarse_alignment import turned, turned_prediction
from groma.tracking.frame.features import FrameFeatures
from groma.tracking.frame.rectification import RightTurn
from groma.tracking.map.keyframes import Followed, wants_keyframe
from groma.tracking.map.track_map import TrackMap
from groma.tracking.options import TrackOptions
from groma.tracking.outcome import (
    FOUND,
    LOST,
    SKIPPED,
    STARTING,
    TRACKED,
    WEAK,
    Entry,
    History,
    TrackedFrame,
    TrackResult,
)
from groma.tracking.pose.estimate import PoseEstimate
from groma.tracking.pose.following import Attempt, find_lines_again, find_points_again, follow_frame, follow_nearby
from groma.tracking.pose.initialise import Initialiser
from groma.tracking.pose.prediction import MotionModel
from groma.tracking.pose.relocalise import Found, promote
from groma.tracking.pose.verification import PoseVerification, misses_much
from groma.tracking.result import about_rest, map_to_scene


class Tracker:
    """Track frames one by one.

    Parameters
    ----------
    camera, options
        The camera of all frames, free of distortion; see :class:`TrackOptions`.
    right_turn
        Rotation of the right camera of a stereo pair, if known from an earlier track.
    saved
        The map of an earlier track (:func:`groma.tracking.map.saved_map.map_of_scene`): the track starts lost in it.
    """

    def __init__(
        self, camera: SequenceCamera, options: TrackOptions | None = None, right_turn: RightTurn | None = None,
        saved: TrackMap | None = None,
    ) -> None:  # fmt: skip
        self.options = given_or_default(options, TrackOptions)
        check_kind(camera, SequenceCamera, "camera", "Pass the camera of a sequence: groma.open_sequence(path).camera.")
        self._given, self.camera = camera, TrackCamera.of(camera)
        self.status = STARTING
        self._gates = self.options.gates.verification
        self._checks = FrameChecks(self.camera, self.options.gates.checks, self.options.max_depth)
        self._motion = MotionModel(self.options.gates.motion)
        self._initialiser: Initialiser | None = None
        self._saved = saved
        self._mapper = Mapper(self.camera, self.options, right_turn, None if saved is None else saved.copy())
        self._ahead = LookAhead(self.camera, self.options, self._mapper.right)
        self._present = Present()
        self._history = History()
        self._verification = PoseVerification(self.camera, self.options)
        # In a saved map the camera can be anywhere, as after a loss.
        self._lost_for, self._lost_since = 0 if saved is None else self._gates.lost_frames + 1, math.nan
        #: The previous frame, if it was lost, and its guessed pose.
        self._guess = np.zeros((0, 0), np.uint8), self._present.pose
        #: Times of the losses between the submaps, for the warnings.
        self._breaks: list[tuple[float, float]] = []
        #: Deferred work of the previous frame, and the rotation of the right camera if the assumed one was wrong.
        self._deferred = DeferredTask(self.options.threaded)
        self._better: RightTurn | None = None
        #: Whether the previous frame had to be relocalised.
        self._searched = False
        self._finished = False

    @property
    def map(self) -> TrackMap:
        """The map so far."""
        self._settle()
        return self._mapper.map

    def begun_anew(self) -> Tracker | None:
        """If the assumed rotation of the right camera was wrong, end this track and return one for the same frames."""
        if self._better is None:
            return None
        self._finished = True
        self._settle()
        self._deferred.close()
        self._mapper.abandon()
        self._mapper.close()
        return Tracker(self._given, self.options, self._better, self._saved)

    # ------------------------------------------------------------------------------------------------- each frame

    def process(self, frame: Frame, following: Frame | None = None) -> TrackedFrame:
        """Track one frame; frames must come in order of time.

        Parameters
        ----------
        frame, following
            The frame and, if already read, the next one: its features are computed in parallel, with the same result.

        The pose is returned before the work on the map that this frame causes, which may last until the next frame.

        Returns
        -------
        TrackedFrame
            Its pose and status. An unusable frame is skipped, with the reason; only a frame of the wrong size or
            kind raises.

        Raises
        ------
        InputError
            If the frame does not have the size of the camera, or images of a wrong type.
        """
        if self._finished:
            raise InputError("This track is finished. Make a new Tracker for further frames.")
        watch = Stopwatch()
        reason = self._checks.reason_to_skip(frame)
        if reason:
            return self._skip(frame, reason, watch)
        present, mapper = self._present, self._mapper
        data = self._ahead.take(frame, mapper.frame_pool, mapper.workers if self._searched else None)
        with watch("map"):
            self._settle()
        if not self.map.keyframes:
            return self._answer(self._start(data, watch))
        attempt, found = self._follow(data, watch), None
        self._searched = attempt.estimate is None
        self._ahead.announce(following, mapper.frame_pool, mapper.workers if self._searched else None)
        if self._searched:
            attempt, found = self._search(data, attempt, watch)
        estimate, followed = attempt.estimate, attempt.followed
        if estimate is None:
            return self._answer(self._lose(data, attempt.predicted, watch))
        pose, status = estimate.pose, FOUND if self._lost_for else TRACKED
        self._motion.update(present.pose if self._lost_for == 0 else None, pose, frame.timestamp)
        if estimate.weak and status == TRACKED:
            status = WEAK
        self._lost_for = 0
        if found is None:
            with watch("lines"):
                followed = find_lines_again(self.map, data, pose, followed)
        present.pose, present.data, present.followed = pose, data, followed
        present.frames_since_keyframe += 1
        # A relocalised frame has few tracked features; the next one needs the landmarks of a keyframe.
        at_once = found is not None and mapper.due is None
        is_keyframe = at_once or self._follow_more(data, watch)
        return self._answer(self._report(frame, status, estimate, is_keyframe, watch), at_once)

    def _follow_more(self, data: FrameFeatures, watch: Stopwatch) -> bool:
        """Search further points where there are few; choose the frame as a keyframe if needed."""
        present, mapper = self._present, self._mapper
        with watch("again"):
            present.followed = find_points_again(mapper.map, data, present.pose, present.followed)
        since = present.frames_since_keyframe
        if mapper.due is not None or not wants_keyframe(
            mapper.map, present.pose, present.followed, since, self.options
        ):
            return False
        nearby = None if mapper.busy else follow_nearby(mapper.map, data, present.pose, present.followed)
        if nearby is not None:
            present.followed, present.frames_since_keyframe = nearby, 0
            return False
        mapper.choose(present, data)
        return True

    def _answer(self, tracked: TrackedFrame, at_once: bool = False) -> TrackedFrame:
        """Start the deferred work on the map for a frame, optionally with a keyframe of it at once."""
        self._deferred.begin(partial(self._mapper.advance, self._present, at_once))
        return tracked

    def _settle(self) -> None:
        """Wait for the deferred work of the previous frame."""
        watch = self._deferred.result()
        if watch is not None:
            self._history.note_stages(watch.seconds)
            self._better = self._mapper.better_turn

    def _follow(self, data: FrameFeatures, watch: Stopwatch) -> Attempt:
        """Predict the pose and track the features of the previous frame, unless it was lost for long."""
        present = self._present
        predicted, prior_sigma = self._motion.predict(present.pose, data.frame.timestamp, self.map.near.depth)
        if self._lost_for > self._gates.lost_frames:
            return Attempt(predicted, prior_sigma)
        assert present.data is not None
        with watch("turn"):
            predicted, prior_sigma = self._with_turn(data, predicted, prior_sigma)
        estimate, followed = follow_frame(
            self.map, present.data, data, present.followed, present.pose, (predicted, prior_sigma), watch,
            self._mapper.frame_pool, self._searched,
        )  # fmt: skip
        if estimate is None:
            return Attempt(predicted, prior_sigma, followed=followed)
        trusted = self._verification.trusts(self.map, data, estimate)
        doubt = not trusted or self._verification.is_surprised(estimate, predicted, prior_sigma) or misses_much(
            self.map, self.camera, present.followed.points, estimate.pose, estimate.counts["points"], self.options.gates
        )  # fmt: skip
        return Attempt(predicted, prior_sigma, *(None, estimate) if doubt else (estimate, None), trusted, followed)

    def _search(self, data: FrameFeatures, attempt: Attempt, watch: Stopwatch) -> tuple[Attempt, Found | None]:
        """Relocalise a frame that could not be tracked by described features, or keep its doubtful pose."""
        present, mapper, unconfirmed = self._present, self._mapper, attempt.unconfirmed
        before = present.pose
        if self._lost_for == 0:
            # The previous frame is the best reference.
            mapper.keep_present(present, watch)
        with watch("find"), work_with(None if mapper.threaded else 1):
            guesses = [attempt.predicted, present.pose] + ([unconfirmed.pose] if unconfirmed is not None else [])
            found = self._verification.find(
                self.map, data, guesses, attempt.predicted, attempt.prior_sigma, self._lost_for,
                self._motion.after_gap, mapper.frame_pool,
            )  # fmt: skip
        if found is not None and not (
            attempt.trusted and unconfirmed is not None and self._verification.score(unconfirmed) >= found.score
        ):
            followed = Followed(promote(self.map, found, data), found.lines)
            return replace(attempt, estimate=found.estimate, followed=followed), found
        if unconfirmed is not None and (attempt.trusted or self._verification.confirms(self.map, data, unconfirmed)):
            # The new keyframe may have moved the map.
            moved = se3.compose(se3.inverse(before[None]), present.pose[None])
            pose = se3.compose(unconfirmed.pose[None], moved)[0]
            return replace(attempt, estimate=replace(unconfirmed, pose=pose)), None
        return attempt, None

    def _with_turn(self, data: FrameFeatures, predicted: FloatArray, prior_sigma: FloatArray):
        """Replace a prediction that contradicts the image by a rotation estimated from the whole image.

        While the previous frame has no pose, rotations from frame to frame give the approximate orientation.
        """
        present, points, gates = self._present, self.map.points, self.options.gates.turns
        assert present.data is not None
        if self._lost_for:
            gray, pose = self._guess
            pose = turned(self.camera, gray, data.gray, pose, gates)
            return pose, np.maximum(prior_sigma, gates.sigma * (1.0 + self._lost_for))
        tracks = present.followed.points
        tracks = tracks.take(points.alive[tracks.index])
        better = turned_prediction(
            self.camera, present.data.small, data.small, (tracks.pixel, points.xyz[tracks.index]),
            partial(present.data.spread_places, present.pose), present.pose, predicted, gates,
        )  # fmt: skip
        if better is None:
            return predicted, prior_sigma
        return better, np.maximum(prior_sigma, [0.0] * 3 + [gates.sigma] * 3)

    # -------------------------------------------------------------------------------------------------- keyframes

    def _start(self, data: FrameFeatures, watch: Stopwatch) -> TrackedFrame:
        """Make the first keyframes: at once where depth is known, else from the motion between two frames."""
        self._initialiser = self._initialiser or Initialiser(self.camera, self.options)
        with watch("start"):
            poses = self._initialiser.try_start(data)
            if poses is None:
                status = STARTING if len(self._mapper.maps) == 1 else LOST
                return self._report(data.frame, status, None, False, watch)
            self._mapper.metric = self._initialiser.metric
            self._present.followed, self._present.pose = self._initialiser.make_map(self.map)
        self._present.data, self._initialiser = data, None
        if len(self._mapper.maps) > 1:
            self._breaks.append((self._lost_since, data.frame.timestamp))
        self._lost_for = 0
        first = self.map.keyframes[0] if len(self.map.keyframes) > 1 else None
        if first is not None:
            self._motion.update(None, first.pose, first.timestamp)
        self._motion.update(None if first is None else first.pose, self._present.pose, data.frame.timestamp)
        self._present.frames_since_keyframe = 0
        if first is not None:
            self._mapper.adjust_start(self._present)
        for one in self.map.keyframes[:-1]:
            self._history.entries.append(Entry(one.timestamp, one.index, se3.identity(), self._mapper.current))
        return self._report(data.frame, TRACKED, None, True, watch)

    # ----------------------------------------------------------------------------------------------------- outcomes

    def _skip(self, frame: Frame, reason: str, watch: Stopwatch) -> TrackedFrame:
        self._history.note(SKIPPED)
        return TrackedFrame(
            frame.timestamp, None, SKIPPED, {}, {"total": watch.elapsed()}, reason=reason,
            name=frame.name,
        )  # fmt: skip

    def _lose(self, data: FrameFeatures, guess: FloatArray, watch: Stopwatch) -> TrackedFrame:
        now = data.frame.timestamp
        if self._lost_for == 0 or math.isnan(self._lost_since):
            self._lost_since = now
        self._lost_for += 1
        self._guess = data.gray, guess
        # A monocular map has its own scale, so no other map can be merged with it.
        stays = self._saved is not None and data.frame.depth is None and data.frame.right is None
        long = self._lost_for > self._gates.lost_frames and now - self._lost_since > self._gates.restart_seconds
        if long and not stays:
            self._mapper.begin_anew(self._present)
            self._present, self._motion = Present(), MotionModel(self.options.gates.motion)
            return self._start(data, watch)
        return self._report(data.frame, LOST, None, False, watch)

    def _report(
        self, frame: Frame, status: str, estimate: PoseEstimate | None, is_keyframe: bool, watch: Stopwatch
    ) -> TrackedFrame:
        """Note a frame with its pose, if the status has one, and return what became of it."""
        self.status = status
        has_pose = status in (TRACKED, FOUND, WEAK)
        if has_pose:
            self._history.note_pose(self.map, frame.timestamp, self._present.pose, self._mapper.current)
        timings = {**watch.seconds, "total": watch.elapsed()}
        self._history.note(status, timings)
        return TrackedFrame(
            frame.timestamp, self._present.pose.copy() if has_pose else None, status,
            estimate.counts if estimate is not None else {}, timings,
            estimate.weak if estimate is not None else (), keyframe=is_keyframe, name=frame.name,
            submap=self._mapper.current,
        )  # fmt: skip

    # ------------------------------------------------------------------------------------------------------ results

    def trajectory(self) -> Trajectory:
        """Return the poses so far in the current submap, by its keyframes; changes nothing."""
        return self._history.trajectory(self.map, self._mapper.current)

    def scene(self) -> Scene:
        """Return the keyframes, points, lines and planes of the current submap; changes nothing."""
        return map_to_scene(self.map, self.camera, self.options.relations)

    def finish(self) -> TrackResult:
        """End the track: merge its submaps where possible, adjust all keyframes together and return the result.

        A step that fails, or that Ctrl-C interrupts, is left out; a warning says so.
        """
        self._finished, mapper, history = True, self._mapper, self._history
        ending = Ending(mapper, history)
        self._deferred.stand_still()
        ending.attempt("what followed the last frame", self._settle, None)
        self._deferred.close()
        ending.settle(self._present)
        where = ending.join()
        roots = sorted({root for root, _ in where if mapper.maps[root].keyframes}) or [0]
        count = {root: sum(entry.submap == root for entry in history.entries) for root in roots}
        main = max(roots, key=lambda root: count[root])
        main = 0 if self._saved is not None and count[0] else main  # the world of the saved map comes first
        others = [root for root in roots if root != main and (count[root] or self._saved is None)]
        for root in others:
            ending.adjust(root)
        adjusted = ending.adjust(main).numbers(self.camera)  # finds planes, which are counted
        statistics = self.statistics() | adjusted
        whole, *submaps = [ending.submap(root) for root in (main, *others)]
        statistics |= {kind: len(getattr(whole.scene, kind)) for kind in ("points", "lines", "planes")}  # as written
        warnings = [*self._checks.warnings, *ending.warnings]
        if not history.entries:
            warnings.append("No map was made: no frame could be used, or the camera did not move enough to start.")
        warnings += about_rest(whole.scene, count[main])
        warnings += about_submaps(self._breaks, where, [count[root] for root in others])
        return TrackResult(whole.trajectory, whole.scene, whole.keyframes, statistics, tuple(warnings), tuple(submaps))

    def statistics(self) -> dict:
        """Return counts and times so far as plain numbers."""
        self._settle()
        out: dict = {
            "frames": dict(self._history.statuses),
            **self._mapper.numbers(),
            "milliseconds": self._history.milliseconds(),
        }
        if self.camera.baseline > 0:
            out["right_camera"] = self._mapper.right.turn.numbers(self.camera)
        return out


__all__ = ["TrackResult", "TrackedFrame", "Tracker"]
