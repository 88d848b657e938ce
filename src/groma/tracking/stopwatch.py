# SPDX-License-Identifier: BSD-3-Clause
"""Timings of the stages of a frame."""

from __future__ import annotations

import time


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
