# SPDX-License-Identifier: BSD-3-Clause
"""What a track says: of each frame, of all of them, and in numbers."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from groma._typing import FloatArray
from groma.geometry import se3
from groma.io.trajectories import Trajectory
from groma.scene import Scene
from groma.tracking.parts import Part
from groma.tracking.track_map import TrackMap

#: What a frame can be.
TRACKED, FOUND, WEAK, LOST, SKIPPED, STARTING = "tracked", "found", "weak", "lost", "skipped", "starting"


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
    #: The map that the pose refers to: 0, or more after the track was lost for long and a new map was begun.
    part: int = 0


@dataclass(frozen=True)
class TrackResult:
    """Outcome of a track."""

    #: Poses of all frames that have one, world_from_cam; of the longest part, if parts could not be joined.
    trajectory: Trajectory
    #: Keyframes with points, lines and planes.
    scene: Scene
    #: Time stamps of the keyframes, in the order of the scene's images.
    keyframes: FloatArray
    statistics: dict
    warnings: tuple[str, ...] = ()
    #: The other parts.
    parts: tuple[Part, ...] = ()


@dataclass
class Entry:
    """A tracked frame in terms of a keyframe, so that it moves when the keyframe is adjusted."""

    timestamp: float
    keyframe: int
    cam_from_keyframe: FloatArray
    #: The map of the keyframe.
    part: int = 0


@dataclass
class History:
    """Poses, statuses and times of the frames so far."""

    entries: list[Entry] = field(default_factory=list)
    statuses: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, list[float]] = field(default_factory=dict)

    def note(self, status: str, seconds: dict[str, float] | None = None) -> None:
        """Count a frame and its times."""
        self.statuses[status] = self.statuses.get(status, 0) + 1
        for stage, value in (seconds or {}).items():
            self.seconds.setdefault(stage, []).append(value)

    def note_pose(self, track_map: TrackMap, timestamp: float, pose: FloatArray, part: int = 0) -> None:
        """Keep a pose in terms of the keyframe that is followed."""
        keyframe = track_map.near
        relative = se3.compose(pose[None], se3.inverse(keyframe.pose[None]))[0]
        self.entries.append(Entry(timestamp, keyframe.index, relative, part))

    def joined(self, where: dict[int, tuple[int, int]]) -> None:
        """Take note of maps that were put into others."""
        for entry in self.entries:
            entry.part, shift = where[entry.part]
            entry.keyframe += shift

    def trajectory(self, track_map: TrackMap, part: int = 0) -> Trajectory:
        """Return the poses in one map as its keyframes stand now."""
        entries = [entry for entry in self.entries if entry.part == part]
        if not entries:
            return Trajectory()
        poses = np.array([track_map.pose_of(entry.keyframe) for entry in entries])
        relative = np.array([entry.cam_from_keyframe for entry in entries]).reshape(-1, 7)
        world = se3.inverse(se3.compose(relative, poses))
        times = np.array([entry.timestamp for entry in entries])
        order = np.argsort(times, kind="stable")
        return Trajectory(times[order], world[order])

    def milliseconds(self) -> dict[str, dict[str, float]]:
        """Return median, 95th percentile and number of the times of each stage."""
        return {
            stage: {
                "median": round(1e3 * float(np.median(seconds)), 3),
                "p95": round(1e3 * float(np.percentile(seconds, 95)), 3),
                "frames": len(seconds),
            }
            for stage, seconds in self.seconds.items()
        }


class Stopwatch:
    """Seconds by stage; stages may repeat."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._stack: list[tuple[str, float]] = []

    def __call__(self, stage: str) -> Stopwatch:
        """Name the stage that the next block times."""
        self._stack.append((stage, time.perf_counter()))
        return self

    def __enter__(self) -> Stopwatch:
        return self

    def __exit__(self, *error: object) -> None:
        stage, began = self._stack.pop()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - began


__all__ = [
    "FOUND",
    "LOST",
    "SKIPPED",
    "STARTING",
    "TRACKED",
    "WEAK",
    "Entry",
    "History",
    "Stopwatch",
    "TrackResult",
    "TrackedFrame",
]
