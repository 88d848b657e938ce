# SPDX-License-Identifier: BSD-3-Clause
"""The results of a track: of each frame, of all of them, and statistics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.geometry import se3
from groma.io.trajectories import Trajectory
from groma.scene import Scene
from groma.tracking.backend.submaps import Submap
from groma.tracking.map.track_map import TrackMap, in_unit

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
    #: Its name in the sequence.
    name: str = ""
    #: The map that the pose refers to: 0, or more after the track was lost for long and a new map was begun.
    submap: int = 0


@dataclass(frozen=True)
class TrackResult:
    """Result of a track: trajectory, map and warnings."""

    #: Poses of all frames that have one, world_from_cam; of the longest submap, if submaps could not be joined.
    trajectory: Trajectory
    #: Keyframes with points, lines and planes.
    scene: Scene
    #: Time stamps of the keyframes, in the order of the scene's images.
    keyframes: FloatArray
    statistics: dict
    warnings: tuple[str, ...] = ()
    #: The other submaps.
    submaps: tuple[Submap, ...] = ()


@dataclass
class Entry:
    """A tracked frame in terms of the keyframe it was tracked against, so that it moves when that is adjusted."""

    timestamp: float
    keyframe: int
    #: (7,) in the unit of the keyframe.
    cam_from_keyframe: FloatArray
    #: The map of the keyframe.
    submap: int = 0


@dataclass
class History:
    """Poses, statuses and times of the frames so far."""

    entries: list[Entry] = field(default_factory=list)
    statuses: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, list[float]] = field(default_factory=dict)

    def note(self, status: str, seconds: dict[str, float] | None = None) -> None:
        """Count a frame and its times."""
        self.statuses[status] = self.statuses.get(status, 0) + 1
        self.note_stages(seconds or {})

    def note_stages(self, seconds: dict[str, float]) -> None:
        """Keep the times of stages."""
        for stage, value in seconds.items():
            self.seconds.setdefault(stage, []).append(value)

    def note_pose(self, track_map: TrackMap, timestamp: float, pose: FloatArray, submap: int = 0) -> None:
        """Keep a pose in terms of the keyframe that is followed."""
        keyframe = track_map.near
        relative = se3.compose(pose[None], se3.inverse(keyframe.pose[None]))[0]
        self.entries.append(Entry(timestamp, keyframe.index, in_unit(relative, 1.0 / keyframe.unit), submap))

    def joined(self, where: Sequence[tuple[int, int]]) -> None:
        """Take note of maps that were put into others."""
        for entry in self.entries:
            entry.submap, shift = where[entry.submap]
            entry.keyframe += shift

    def trajectory(self, track_map: TrackMap, submap: int = 0) -> Trajectory:
        """Return the poses in one map as its keyframes stand now."""
        entries = [entry for entry in self.entries if entry.submap == submap]
        if not entries:
            return Trajectory()
        entries.sort(key=lambda entry: entry.timestamp)
        times = np.array([entry.timestamp for entry in entries])
        near = np.array([entry.keyframe for entry in entries])
        poses = np.array([track_map.pose_of(entry.keyframe) for entry in entries])
        moved = [in_unit(entry.cam_from_keyframe, track_map.unit_of(entry.keyframe)) for entry in entries]
        poses = se3.compose(np.array(moved), poses)
        number = {keyframe.timestamp: keyframe.index for keyframe in track_map.keyframes}
        own = np.array([number.get(time, -1) for time in times.tolist()])
        rows = np.flatnonzero(own >= 0)
        adjusted = np.array([track_map.pose_of(k) for k in own[rows]]).reshape(-1, 7)
        return Trajectory(times, se3.inverse(_as_adjusted(times, poses, near, own, adjusted)))

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


def _as_adjusted(times: FloatArray, poses: FloatArray, near: IntArray, own: IntArray, adjusted: FloatArray):
    """Put frames that became keyframes where these are now; frames between them move along, in proportion to time.

    Parameters
    ----------
    times, poses : (n,), (n, 7)
        Frames in order of time, as they were tracked.
    near : (n,) int
        The keyframe that each was tracked against.
    own : (n,) int
        The keyframe that it became, or -1.
    adjusted : (k, 7)
        Poses of those that became keyframes.
    """
    rows = np.flatnonzero(own >= 0)
    if not len(rows):
        return poses
    moved = se3.log(se3.compose(adjusted, se3.inverse(poses[rows])))
    after = np.searchsorted(rows, np.arange(len(times)), side="right")
    first, second = np.maximum(after - 1, 0), np.minimum(after, len(rows) - 1)
    # What was tracked against the keyframe before has not moved there; what was tracked against an older one has, like
    # that keyframe itself.
    known = (after > 0) & (near[rows[first]] == near) & (own[rows[first]] != near)
    start = np.where(known[:, None], moved[first], 0.0)
    known = (after < len(rows)) & (near[rows[second]] == near)
    end = np.where(known[:, None], moved[second], start)
    gap = times[rows[second]] - times[rows[first]]
    share = np.where((after > 0) & (gap > 0), (times - times[rows[first]]) / np.where(gap > 0, gap, 1.0), 0.0)[:, None]
    out = se3.compose(se3.exp((1.0 - share) * start + share * end), poses)
    out[rows] = adjusted
    return out
