# SPDX-License-Identifier: BSD-3-Clause
"""What goes on, for programs that groma is a part of: the logger ``groma`` and, below it, one for each area.

``groma.mapping``, ``groma.tracking``, ``groma.localization`` and ``groma.adjustment`` get each stage when it begins,
and what each result is (INFO), steps, parts of stages and frames (DEBUG), and what is odd (WARNING). Nothing is printed
unless the program asks for it, with ``logging.basicConfig`` or a handler.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from typing import Literal

Area = Literal["adjustment", "localization", "mapping", "tracking"]
StageProgress = Callable[[str, int, int], None]

logging.getLogger("groma").addHandler(logging.NullHandler())


def logger_of(area: Area) -> logging.Logger:
    """Return the logger of an area."""
    return logging.getLogger(f"groma.{area}")


def logged_stages(area: Area, progress: StageProgress | None) -> StageProgress:
    """Return a progress callback that logs stages and their parts, and passes them on."""
    log, last = logger_of(area), [""]

    def say(stage: str, done: int, total: int) -> None:
        if stage != last[0]:
            last[0] = stage
            log.info(stage)
        elif total > 1:
            log.debug("%s: %d of %d", stage, done, total)
        if progress is not None:
            progress(stage, done, total)

    return say


def log_warnings(area: Area, sentences: Iterable[str]) -> None:
    """Log what is odd about a result."""
    for sentence in sentences:
        logger_of(area).warning(sentence)
