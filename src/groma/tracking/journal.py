# SPDX-License-Identifier: BSD-3-Clause
"""Finished keyframes on disk during a track, so that little is lost if it is killed, and the current picture."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from groma.geometry import se3
from groma.io import write_scene
from groma.io.trajectories import write_tum
from groma.mapping.checkpoints import system_reason
from groma.mapping.folder_lock import LOCK, lock_folder
from groma.tracking.map.keyframes import Followed

if TYPE_CHECKING:
    from groma.io.sequences.frame import Frame
    from groma.tracking.tracker import TrackedFrame, Tracker

#: Seconds between two writes of the current picture, and its maximum width (cost: time of writing).
GLANCE, COLUMNS = 0.4, 640
#: The whole map is written when this many seconds have passed, and writing took less than this share of the time (cost:
#: of writing).
EVERY, SHARE = 2.0, 0.03


class Journal:
    """A folder with ``frames.txt`` and ``keyframes.txt`` (as they were tracked), ``trajectory.txt`` and ``scene.npz``.

    Rows are those of TUM: time, place, quaternion; in ``frames.txt`` the number of the map follows. ``statuses.txt``
    has a row for every frame (time, status, numbers of points, lines and planes that agree, whether it is a keyframe),
    and ``now.npz`` the latest picture with its tracked features. The folder is locked until the journal is closed.
    Once it cannot be written, as on a full disk, nothing more is noted, and the track goes on.

    Raises
    ------
    OutputError
        If another process works in the folder, or it cannot be made or written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._lock = folder, lock_folder(folder)
        #: Why nothing is noted any more, for the user; empty while all is well.
        self.warnings: list[str] = []
        self.begin_anew()

    def begin_anew(self) -> None:
        """Forget what was noted."""
        for entry in self._folder.iterdir():
            if entry.is_dir():
                shutil.rmtree(entry, ignore_errors=True)
            elif entry.name != LOCK:
                entry.unlink()
        self._next = self._next_glance = 0.0

    def close(self) -> None:
        """Give the folder free for others; what was noted stays."""
        self._lock.close()

    def _keep(self, note: Callable[[], None]) -> None:
        try:
            if not self.warnings:
                note()
        except OSError as error:
            self.warnings.append(
                f"From some frame on nothing was kept in {self._folder} while the track ran: {system_reason(error)}."
            )

    def frame(self, tracked: TrackedFrame, frame: Frame, tracker: Tracker) -> None:
        """Note what became of a frame, its pose if it has one, and now and then the picture."""
        self._keep(lambda: self._frame(tracked, frame, tracker))

    def _frame(self, tracked: TrackedFrame, frame: Frame, tracker: Tracker) -> None:
        if tracked.pose is not None:
            self._append("frames.txt", tracked, str(tracked.submap))
        counts = [str(tracked.counts.get(kind, 0)) for kind in ("points", "lines", "planes")]
        with (self._folder / "statuses.txt").open("a", encoding="utf-8") as file:
            file.write(" ".join([repr(tracked.timestamp), tracked.status, *counts, str(int(tracked.keyframe))]) + "\n")
        if time.monotonic() >= self._next_glance:
            self._glance(tracked, frame, tracker)
            self._next_glance = time.monotonic() + GLANCE

    def _glance(self, tracked: TrackedFrame, frame: Frame, tracker: Tracker) -> None:
        """Write the picture of a frame and its tracked features, in pixels of the reduced picture."""
        import cv2

        scale = min(1.0, COLUMNS / frame.gray.shape[1])
        picture = cv2.resize(frame.gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        followed = tracker._present.followed if tracked.pose is not None else Followed.nothing()
        points, segments = followed.points.pixel, followed.lines.ends
        draft = self._folder / "now.draft"
        with draft.open("wb") as file:
            np.savez(file, picture=picture, points=scale * points, segments=scale * segments)
        os.replace(draft, self._folder / "now.npz")

    def _append(self, name: str, frame: TrackedFrame, *more: str) -> None:
        assert frame.pose is not None
        world = se3.inverse(frame.pose[None])[0]
        row = [*map(repr, [frame.timestamp, *world[4:].tolist(), *world[:4].tolist()]), *more]
        with (self._folder / name).open("a", encoding="utf-8") as file:
            file.write(" ".join(row) + "\n")

    def keyframe(self, tracker: Tracker, frame: TrackedFrame) -> None:
        """Note a keyframe that was just made."""
        self._keep(lambda: self._keyframe(tracker, frame))

    def _keyframe(self, tracker: Tracker, frame: TrackedFrame) -> None:
        self._append("keyframes.txt", frame)
        began = time.monotonic()
        if began < self._next:
            return
        write_tum(tracker.trajectory(), self._folder / "trajectory.txt", force=True)
        write_scene(tracker.scene(), self._folder / "scene.npz", force=True)
        took = time.monotonic() - began
        self._next = time.monotonic() + max(EVERY, took / SHARE)
