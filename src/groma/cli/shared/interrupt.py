# SPDX-License-Identifier: BSD-3-Clause
"""Ctrl-C and SIGTERM during a command.

A signal that arrives while a package is imported, or while a compiler calls back into Python, is swallowed, or turns
into an error of the package or the compiler. The request is therefore recorded, and checked when an error is caught and
at the next progress.
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
    """Whether an interrupt was requested."""

    def __init__(self) -> None:
        self.asked = False
        #: Whether the interruption was reported.
        self.told = False
        #: Whether an interrupt is the regular end: what comes after the first is ignored.
        self.regular = False

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Record a signal and interrupt."""
        if self.asked and self.regular:
            return
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
        """Report the interruption once, and return the exit code."""
        if not self.told:
            self.told = True
            print(f"groma: interrupted; {words}", file=sys.stderr, flush=True)
        return INTERRUPTED

    def explains(self, error: BaseException) -> bool:
        """Whether an error may be due to an interrupt: any but one of groma alone or of the system."""
        if not self.asked:
            return False
        from groma.errors import causes_of

        kinds = {type(one).__module__.partition(".")[0] for one in causes_of(error)}
        return kinds != {"groma"} and not isinstance(error, OSError)


#: That of the process.
PROCESS = Interruption()


def answer_signals() -> None:
    """Handle Ctrl-C and SIGTERM from now on, unless the process was started with them ignored."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, _end_process)


def ignore_signals() -> None:
    """Ignore signals from now on: the command is done, the interpreter finalises."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def _end_process(number: int, frame: FrameType | None) -> None:
    # Objects whose construction was interrupted may fail in their finaliser.
    sys.unraisablehook = lambda unraisable: None
    PROCESS.handle(number, frame)


@contextmanager
def interruptible() -> Iterator[Interruption]:
    """Turn Ctrl-C and SIGTERM inside the block into KeyboardInterrupt, also if a library turns them into its errors."""
    state = Interruption()
    mine = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, state.handle) for number in (signal.SIGINT, signal.SIGTERM) if mine}
    try:
        yield state
    except Exception:  # of any kind: libraries turn an interrupt into errors of their own
        if state.asked:
            raise KeyboardInterrupt from None
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def stages_that_are_kept(console: "Console", words: str) -> Iterator[Callable[[str, int, int], None]]:
    """Yield the progress of stages; Ctrl-C ends the command with a message about what is kept."""
    import typer

    try:
        with interruptible() as interruption, console.stages() as stages:
            yield interruption.checking(stages)
    except KeyboardInterrupt:
        raise typer.Exit(PROCESS.tell(f"{words}: the same command resumes there.")) from None
