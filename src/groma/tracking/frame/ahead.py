# SPDX-License-Identifier: BSD-3-Clause
"""Features of a frame, computed in other threads: while the one before is searched, or from when it is there."""

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

    def take(self, frame: Frame, pool: Executor | None, searching: Executor | None) -> FrameFeatures:
        """Return what was found in a frame, or begin with it if another one was announced."""
        ahead, self._next = self._next, None
        return ahead if ahead is not None and ahead.frame is frame else self._begun(frame, pool, searching)

    def announce(self, frame: Frame | None, pool: Executor | None, searching: Executor | None) -> None:
        """Begin with the next frame, if it is known; with what a search needs where there are workers for that.

        It is called when this frame has been followed. Until then the keyframe before it, its adjustment and following
        itself are waited for, and need the cores.
        """
        if frame is not None:
            self._next = self._begun(frame, pool, searching)

    def _begun(self, frame: Frame, pool: Executor | None, searching: Executor | None) -> FrameFeatures:
        found = FrameFeatures(frame, *self._given)
        if pool is not None:
            found.prepare_ahead(pool, searching)
        return found
