# SPDX-License-Identifier: BSD-3-Clause
"""What a command says: text, tables, warnings, and what goes on meanwhile."""

import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from groma._counted import counted
from groma.cli.shared.progress import Plan, Progress, Stages
from groma.cli.shared.style import Style, aligned, can_rewrite, is_terminal, paint, terminal_width, wrapped

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


class Console:
    """Speaks on standard output, or on standard error when the report goes to standard output."""

    def __init__(self, quiet: bool, verbose: bool, json_target: str | None, threads: int | None = None) -> None:
        self.quiet = quiet
        self.verbose = verbose and not quiet
        #: Where a machine-readable report goes; None for no report.
        self.json_target = json_target
        #: The most threads that may be used; None for as many as pay.
        self.threads = threads
        self._stream = sys.stderr if json_target == "-" else sys.stdout
        self._plan = Plan()
        if threads is not None:
            # Read by the numerical libraries when they are loaded, which has not happened yet.
            for variable in _THREAD_VARIABLES:
                os.environ[variable] = str(threads)

    def say(self, text: str = "") -> None:
        """Print a sentence unless --quiet; on a terminal it is broken between words."""
        if not self.quiet:
            text = wrapped(text, terminal_width()) if is_terminal(self._stream) else text
            print(text, file=self._stream, flush=True)

    def detail(self, text: str) -> None:
        """Print a line with --verbose."""
        if self.verbose:
            self.say(text)

    def table(self, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Print an aligned table unless --quiet; nothing if it has no rows."""
        if rows and not self.quiet:
            top, lines = aligned(header, rows, terminal_width() if is_terminal(self._stream) else None)
            top = [paint(line, "bold", self._stream) for line in top]
            print("\n".join([*top, *lines]), file=self._stream, flush=True)

    def warn(self, text: str) -> None:
        """Print a warning on standard error unless --quiet."""
        if not self.quiet:
            warn(text)

    def warn_of_all(self, texts: Sequence[str], most: int = 3) -> None:
        """Print warnings; of more than ``most`` that differ in their numbers alone the first, and how many follow it.

        A folder with one thing wrong in every file is told once, and the report for machines has all of them.
        """
        alike: dict[str, list[str]] = {}
        for text in texts:
            alike.setdefault(re.sub(r"\d+", "0", text), []).append(text)
        for first, *others in alike.values():
            if len(others) < most:
                for text in (first, *others):
                    self.warn(text)
            else:
                self.warn(f"{first} The same of {counted(len(others), 'others')}.")

    def wrote(self, *places: object) -> None:
        """Say that something was written, and where."""
        if not self.quiet:
            for place in places:
                line = f"Wrote {place}"
                if not isinstance(place, Path) and is_terminal(self._stream):  # a path alone is copied
                    line = wrapped(line, terminal_width())
                print(line.replace("Wrote", paint("Wrote", "green", self._stream), 1), file=self._stream, flush=True)

    def wrote_page(self, folder: Path) -> None:
        """Say that a folder was written, and where the page in it is."""
        self.wrote(folder)
        if not self.quiet:  # never broken: it is copied
            print(f"Open {(folder / 'report.html').absolute()} in a browser.", file=self._stream, flush=True)

    def expect_compilation(self, work: str) -> None:
        """Say so when something must be compiled that a kind of work needs, and let other processes help with it.

        Nothing is said, and no process started, unless it happens.
        """
        from groma.compilation import ahead

        ahead.expect(work, self._announce_compilation, self.threads)

    def _announce_compilation(self) -> None:
        if not self.quiet and can_rewrite(sys.stderr):
            sys.stderr.write("\r\x1b[K")  # the line of progress
        self.say("First run: compiling for this machine. Later runs start at once.")

    def progress(self) -> Progress:
        """Return the progress of an adjustment; see :class:`groma.cli.shared.progress.Line` for where it is shown."""
        return Progress(self.quiet)

    def expect_stages(self, *names: str) -> None:
        """Tell which stages are to come, so that they are counted; what was told first counts."""
        if not self._plan.names:
            self._plan = Plan(names)

    def stages(self) -> Stages:
        """Return the progress of a pipeline of named stages, which are counted where they were announced.

        With --verbose every stage leaves a line with its time, on a terminal or not.
        """
        return Stages(self.quiet, self._plan, finished=self.detail if self.verbose else None)


def warn(text: str) -> None:
    """Print a warning on standard error."""
    complain("warning:", text, "yellow")


def complain(what: str, text: str, style: Style) -> None:
    """Print a sentence and what it is on standard error; on a terminal it is broken between words."""
    line = f"{what} {text}"
    if is_terminal(sys.stderr):
        line = wrapped(line, terminal_width()).replace(what, paint(what, style, sys.stderr), 1)
    print(line, file=sys.stderr, flush=True)
