# SPDX-License-Identifier: BSD-3-Clause
"""Ctrl-C and a polite request to end (SIGTERM), in work that calls into libraries that mishandle them.

A signal that arrives while a compiler calls back into Python is swallowed, or comes out as an error of the compiler.
What was asked for is therefore remembered, and looked up when an error comes, and at the next progress.
"""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

#: Exit code of a command that was interrupted.
INTERRUPTED = 130


class Interruption:
    """Whether the user asked to stop."""

    def __init__(self) -> None:
        self.asked = False

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Remember a signal, and interrupt."""
        self.asked = True
        raise KeyboardInterrupt

    def checking(self, progress: Callable[[str, int, int], None]) -> Callable[[str, int, int], None]:
        """Return a progress callback that interrupts if an earlier interrupt was swallowed."""

        def checked(stage: str, done: int, total: int) -> None:
            if self.asked:
                raise KeyboardInterrupt
            progress(stage, done, total)

        return checked


@contextmanager
def interruptible() -> Iterator[Interruption]:
    """Turn Ctrl-C and SIGTERM inside the block into KeyboardInterrupt, whatever they become on their way."""
    import pycolmap  # noqa: F401 - takes SIGTERM when it is loaded, and answers it with a page of addresses

    state = Interruption()
    mine = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, state.handle) for number in (signal.SIGINT, signal.SIGTERM) if mine}
    try:
        yield state
    except Exception:  # of any kind: what an interrupt becomes on its way is up to the library that was interrupted
        if state.asked:
            raise KeyboardInterrupt from None
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


__all__ = ["INTERRUPTED", "Interruption", "interruptible"]
