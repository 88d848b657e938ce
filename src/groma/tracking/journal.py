# SPDX-License-Identifier: BSD-3-Clause
"""Finished keyframes on disk while a track goes on, so that little is lost when it is killed."""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING

from groma.geometry import se3
from groma.io import write_scene
from groma.io.trajectories import write_tum

if TYPE_CHECKING:
    from groma.tracking.tracker import TrackedFrame, Tracker

#: The whole map is written when this many seconds have passed, and writing took less than this share of the time.
EVERY, SHARE = 2.0, 0.03


class Journal:
    """A folder with ``frames.txt`` and ``keyframes.txt`` (as they were tracked), ``trajectory.txt`` and ``scene.npz``.

    Rows are those of TUM: time, place, quaternion; in ``frames.txt`` the number of the map follows.
    """

    def __init__(self, folder: Path) -> None:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        self._folder = folder
        self._next = 0.0

    def frame(self, frame: TrackedFrame) -> None:
        """Note a frame that has a pose."""
        if frame.pose is not None:
            self._append("frames.txt", frame, str(frame.submap))

    def _append(self, name: str, frame: TrackedFrame, *more: str) -> None:
        assert frame.pose is not None
        world = se3.inverse(frame.pose[None])[0]
        row = [*map(repr, [frame.timestamp, *world[4:].tolist(), *world[:4].tolist()]), *more]
        with (self._folder / name).open("a", encoding="utf-8") as file:
            file.write(" ".join(row) + "\n")

    def keyframe(self, tracker: Tracker, frame: TrackedFrame) -> None:
        """Note a keyframe that was just made."""
        self._append("keyframes.txt", frame)
        began = time.monotonic()
        if began < self._next:
            return
        write_tum(tracker.trajectory(), self._folder / "trajectory.txt", force=True)
        write_scene(tracker.scene(), self._folder / "scene.npz", force=True)
        took = time.monotonic() - began
        self._next = time.monotonic() + max(EVERY, took / SHARE)


__all__ = ["Journal"]
