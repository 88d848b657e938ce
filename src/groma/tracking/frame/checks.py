# SPDX-License-Identifier: BSD-3-Clause
"""Frames that cannot be tracked: wrong in kind (an error), or with nothing to see (skipped, with a reason)."""

from __future__ import annotations

import math

import numpy as np

from groma._counted import counted
from groma.errors import InputError, ShapeError
from groma.features.images import IMAGES
from groma.gates import NORMAL
from groma.io.sequences.frame import Frame
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.gates import DEFAULT, CheckGates


class FrameChecks:
    """Checks frames one by one, and collects the warnings."""

    def __init__(self, camera: TrackCamera, gates: CheckGates = DEFAULT.checks, max_depth: float = math.inf) -> None:
        self._camera, self._gates, self._max_depth = camera, gates, max_depth
        self._last_time = -math.inf
        self._last_small: np.ndarray | None = None
        self._counts: dict[str, int] = {}

    def reason_to_skip(self, frame: Frame) -> str:
        """Return why a frame cannot be used, or nothing."""
        self._check(frame)
        reason = ""
        if not math.isfinite(frame.timestamp):
            reason = "its time stamp is not a number"
        elif frame.timestamp <= self._last_time:
            reason = "its time stamp is not after the one before"
        else:
            small = frame.gray[::8, ::8].astype(np.float32)
            level, contrast = float(small.mean()), float(small.std())
            if contrast < NORMAL.alike * IMAGES.noise:
                # convention: words of a message
                reason = "it is black" if level < 60 else "it is overexposed" if level > 200 else "it shows nothing"
            self._last_time = frame.timestamp
            if not reason:
                if self._last_small is not None and np.array_equal(small, self._last_small):
                    self._count("repeated the picture before")
                self._last_small = small
                if frame.depth is not None:
                    depth = frame.depth[::8, ::8]
                    known = depth > 0
                    if float(known.mean()) < self._gates.sparse_depth:
                        self._count("had depth in less than a fifth of the picture")
                    elif float((known & (depth <= self._max_depth)).mean()) < self._gates.sparse_depth:
                        self._count(
                            f"had depth of up to {self._max_depth:g} m, the largest that is used, in less than a fifth "
                            "of the picture: check the depth scale (--depth-scale), or raise --max-depth (max_depth=)"
                        )
        if reason:
            self._count(f"skipped: {reason}")
        return reason

    def _count(self, what: str) -> None:
        self._counts[what] = self._counts.get(what, 0) + 1

    @property
    def warnings(self) -> list[str]:
        """Sentences about all frames so far."""
        return [
            f"{counted(count, 'frames')} {what}" + (" before." if what.endswith("one") else ".")
            for what, count in self._counts.items()
        ]

    def _check(self, frame: Frame) -> None:
        shape = (self._camera.height, self._camera.width)
        for name, dtype in (("gray", np.uint8), ("right", np.uint8), ("depth", np.float32)):
            image = getattr(frame, name)
            if image is None and name != "gray":
                continue
            if not isinstance(image, np.ndarray) or image.shape != shape:
                raise ShapeError(
                    f"Frame.{name} must have shape {shape}, the size of the camera (height, width); "
                    f"got {getattr(image, 'shape', type(image).__name__)}."
                )
            if image.dtype != dtype:
                raise InputError(f"Frame.{name} must be {np.dtype(dtype).name}; got {image.dtype}. Convert it.")
        if frame.right is not None and not self._camera.baseline > 0:
            raise InputError("Frames have a right image, but the camera has no baseline. Set SequenceCamera.baseline.")
