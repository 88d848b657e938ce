# SPDX-License-Identifier: BSD-3-Clause
"""Ctrl-C and a polite request to end (SIGTERM), from the first moment of a command to its last.

A signal that arrives while a package is imported or a compiler calls back into Python is swallowed, or comes out as
an error of the package or the compiler. What was asked for is therefore remembered, and looked up when an error comes,
and at the next progress.
"""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from groma.cli.shared.console import Console

#: Exit code of a command that was interrupted.
INTERRUPTED = 130


class Interruption:
    """Whether the user asked to stop."""

    def __init__(self) -> None:
        self.asked = False
        #: Whether the user was told that the command ends.
        self.told = False

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

    def tell(self, words: str = "nothing is left half written.") -> int:
        """Say once that the command was interrupted, and return its exit code."""
        if not self.told:
            self.told = True
            print(f"groma: interrupted; {words}", file=sys.stderr, flush=True)
        return INTERRUPTED

    def explains(self, error: BaseException) -> bool:
        """Whether an error may be what an interrupt became on its way: any but a plain one of groma or the system."""
        if not self.asked:
            return False
        from groma.errors import causes_of

        kinds = {type(one).__module__.partition(".")[0] for one in causes_of(error)}
        return kinds != {"groma"} and not isinstance(error, OSError)


#: Of the process, from the start of the command line on.
PROCESS = Interruption()


def answer_signals() -> None:
    """Let Ctrl-C and SIGTERM interrupt the process from now on; those that it was told to ignore it ignores."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, _end_process)


def ignore_signals() -> None:
    """Let nothing interrupt what is left: the command is done, and Python tidies up."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def _end_process(number: int, frame: FrameType | None) -> None:
    # Objects of libraries that were interrupted while they were made complain when they are thrown away.
    sys.unraisablehook = lambda unraisable: None
    PROCESS.handle(number, frame)


@contextmanager
def interruptible() -> Iterator[Interruption]:
    """Turn Ctrl-C and SIGTERM inside the block into KeyboardInterrupt, whatever they become on their way."""
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


@contextmanager
def stages_that_are_kept(console: "Console", words: str) -> Iterator[Callable[[str, int, int], None]]:
    """Yield the progress of stages; Ctrl-C ends the command, and says with some words what is kept of them."""
    import typer

    try:
        with interruptible() as interruption, console.stages() as stages:
            yield interruption.checking(stages)
    except KeyboardInterrupt:
        raise typer.Exit(PROCESS.tell(f"{words}: the same command resumes there.")) from None
