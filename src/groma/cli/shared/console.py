# SPDX-License-Identifier: BSD-3-Clause
"""What a command says: text, warnings, one progress line on a terminal."""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


class Console:
    """Speaks on standard output, or on standard error when the report goes to standard output."""

    def __init__(self, quiet: bool, verbose: bool, json_target: str | None, threads: int | None = None) -> None:
        self.quiet = quiet
        self.verbose = verbose and not quiet
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

    def announce_compilation(self) -> None:
        """Say so when kernels are about to be compiled for the first time, because it takes a while."""
        if not _cache_is_filled():
            self.say("First run: compiling for this machine. Later runs start at once.")

    def progress(self) -> "Progress":
        """Return a progress line; silent when not on a terminal."""
        return Progress(enabled=not self.quiet and sys.stderr.isatty())

    def stages(self) -> "Stages":
        """Return a progress line for a pipeline of named stages; silent when not on a terminal.

        With --verbose every stage leaves a line with its time, on a terminal or not.
        """
        return Stages(enabled=not self.quiet and sys.stderr.isatty(), finished=self.detail if self.verbose else None)


class _Line:
    """One line on the terminal that rewrites itself, and vanishes at the end."""

    def __init__(self, enabled: bool) -> None:
        self._enabled = enabled

    def _show(self, text: str) -> None:
        if self._enabled:
            sys.stderr.write(f"\r\x1b[K  {text}")
            sys.stderr.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._wipe()

    def _wipe(self) -> None:
        if self._enabled:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()


class Progress(_Line):
    """Call it with the progress events of an adjustment."""

    def __call__(self, event: Any) -> None:
        """Show one event: iteration, limit and cost."""
        self._show(f"step {event.iteration}/{event.max_iterations}   cost {event.cost:.6g}")


class Stages(_Line):
    """Call it with the name of a stage, what is done and what there is to do."""

    def __init__(self, enabled: bool, finished: Callable[[str], None] | None = None) -> None:
        super().__init__(enabled)
        self._finished = finished
        self._stage = ""
        self._since = time.perf_counter()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show a stage."""
        if stage != self._stage:
            self._leave()
            self._stage = stage
        self._show(f"{stage} {done}/{total}" if total > 1 else stage)

    def _leave(self) -> None:
        now = time.perf_counter()
        if self._stage and self._finished is not None:
            self._wipe()
            self._finished(f"  {self._stage}: {now - self._since:.1f} s")
        self._since = now


def _cache_is_filled() -> bool:
    """Whether compiled kernels of this package lie in the cache, wherever Numba keeps it."""
    package = Path(__file__).resolve().parents[1]
    folders = [package]
    if "NUMBA_CACHE_DIR" in os.environ:
        folders = [Path(os.environ["NUMBA_CACHE_DIR"])]
    elif not os.access(package, os.W_OK):
        return True  # a per-user folder that only Numba knows; better silent than wrong
    return any(next(folder.rglob("*.nbc"), None) is not None for folder in folders if folder.is_dir())
