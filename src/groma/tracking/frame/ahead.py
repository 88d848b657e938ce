# SPDX-License-Identifier: BSD-3-Clause
"""Features of the next frame, if known, computed in other threads."""

from __future__ import annotations

from concurrent.futures import Executor

from groma.io.sequences.frame import Frame
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.frame.features import FrameFeatures
from groma.tracking.frame.rectification import RightCamera
from groma.tracking.options import TrackOptions


class LookAhead:
    """Makes :class:`FrameFeatures` of frames, of the next one early."""

    def __init__(self, camera: TrackCamera, options: TrackOptions, right: RightCamera) -> None:
        self._given = camera, options, right
        self._next: FrameFeatures | None = None

    def take(self, frame: Frame) -> FrameFeatures:
        """Return what was found in a frame, or nothing yet if another one was announced."""
        ahead, self._next = self._next, None
        return ahead if ahead is not None and ahead.frame is frame else FrameFeatures(frame, *self._given)

    def announce(self, frame: Frame | None, pool: Executor | None, searching: Executor | None) -> None:
        """Begin with the next frame, if it is known; with what a search needs where there are workers for that."""
        if frame is not None and pool is not None:
            self._next = FrameFeatures(frame, *self._given)
            self._next.prepare_ahead(pool, searching)
