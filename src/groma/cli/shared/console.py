# SPDX-License-Identifier: BSD-3-Clause
"""What a command says: text, warnings, one progress line on a terminal."""

import os
import shutil
import sys
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

#: Seconds between two lines where progress cannot rewrite itself, and characters of a full bar.
PAUSE, BAR = 10.0, 20
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


class Console:
    """Speaks on standard output, or on standard error when the report goes to standard output."""

    def __init__(self, quiet: bool, verbose: bool, json_target: str | None, threads: int | None = None) -> None:
        self.quiet = quiet
        self.verbose = verbose and not quiet
        self._threads = threads
        self._stream = sys.stderr if json_target == "-" else sys.stdout
        if threads is not None:
            # Read by the numerical libraries when they are loaded, which has not happened yet.
            for variable in _THREAD_VARIABLES:
                os.environ[variable] = str(threads)

    def say(self, text: str = "") -> None:
        """Print a line unless --quiet."""
        if not self.quiet:
            print(text, file=self._stream, flush=True)

    def detail(self, text: str) -> None:
        """Print a line with --verbose."""
        if self.verbose:
            print(text, file=self._stream, flush=True)

    def warn(self, text: str) -> None:
        """Print a warning on standard error unless --quiet."""
        if not self.quiet:
            print(f"warning: {text}", file=sys.stderr, flush=True)

    def expect_compilation(self, work: str) -> None:
        """Say so when something must be compiled that a kind of work needs, and let other processes help with it.

        Nothing is said, and no process started, unless it happens.
        """
        from groma.compilation import ahead

        ahead.expect(work, self._announce_compilation, self._threads)

    def _announce_compilation(self) -> None:
        if not self.quiet and sys.stderr.isatty():
            sys.stderr.write("\r\x1b[K")  # the line of progress
        self.say("First run: compiling for this machine. Later runs start at once.")

    def progress(self) -> "Progress":
        """Return the progress of an adjustment; see :class:`_Line` for where it is shown."""
        return Progress(self.quiet)

    def stages(self) -> "Stages":
        """Return the progress of a pipeline of named stages.

        With --verbose every stage leaves a line with its time, on a terminal or not.
        """
        return Stages(self.quiet, finished=self.detail if self.verbose else None)


class _Line:
    """What goes on, on standard error.

    On a terminal it is one line that rewrites itself and vanishes at the end; in a pipe or a file, a line every ten
    seconds.
    """

    def __init__(self, quiet: bool) -> None:
        self._is_terminal = not quiet and sys.stderr.isatty()
        self._is_heard = not quiet
        self._last = time.monotonic()

    def _show(self, text: str) -> None:
        if self._is_terminal:
            width = shutil.get_terminal_size().columns
            sys.stderr.write(f"\r\x1b[K  {text}"[: width + 3])
            sys.stderr.flush()
        elif self._is_heard and time.monotonic() - self._last >= PAUSE:
            self._last = time.monotonic()
            print(f"  {text}", file=sys.stderr, flush=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._wipe()

    def _wipe(self) -> None:
        if self._is_terminal:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()


class Progress(_Line):
    """Call it with the progress events of an adjustment."""

    def __call__(self, event: Any) -> None:
        """Show one event: iteration, limit and cost."""
        self._show(f"step {event.iteration}/{event.max_iterations}   cost {event.cost:.6g}")


class Stages(_Line):
    """Call it with the name of a stage, what is done and what there is to do."""

    def __init__(self, quiet: bool, finished: Callable[[str], None] | None = None) -> None:
        super().__init__(quiet)
        self._finished = finished
        self._stage = ""
        self._number = 0
        self._since = time.perf_counter()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show a stage."""
        if stage != self._stage:
            self._leave()
            self._stage = stage
            self._number += 1
        self._show(stage_line(self._number, stage, done, total, time.perf_counter() - self._since))

    def _leave(self) -> None:
        now = time.perf_counter()
        if self._stage and self._finished is not None:
            self._wipe()
            self._finished(f"  {self._stage}: {now - self._since:.1f} s")
        self._since = now


def stage_line(number: int, stage: str, done: int, total: int, seconds: float) -> str:
    """Return what is shown of a stage: its number, a bar where it has parts, and about how long it still takes."""
    start = f"{number:>2}. {stage}"
    if total <= 1:
        return start
    filled = BAR * min(done, total) // total
    remaining = f", {say_seconds(seconds * (total - done) / done)} left" if 0 < done < total and seconds > 1.0 else ""
    return f"{start}  [{'#' * filled}{'.' * (BAR - filled)}] {done:,}/{total:,}{remaining}"


def say_seconds(seconds: float) -> str:
    """Return a length of time in two units at most: ``40 s``, ``2 min 5 s``, ``3 h 10 min``."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
