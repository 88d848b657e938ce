# SPDX-License-Identifier: BSD-3-Clause
"""Output of a command: text, tables, warnings and progress."""

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
    """Prints to standard output, or to standard error if the report goes to standard output."""

    def __init__(self, quiet: bool, verbose: bool, json_target: str | None, threads: int | None = None) -> None:
        self.quiet = quiet
        self.verbose = verbose and not quiet
        #: Value of --json; None: no report.
        self.json_target = json_target
        #: Maximum number of threads; None: automatic.
        self.threads = threads
        self._stream = sys.stderr if json_target == "-" else sys.stdout
        self._plan = Plan()
        if threads is not None:
            # Read by the numerical libraries when they are loaded, which is later.
            for variable in _THREAD_VARIABLES:
                os.environ[variable] = str(threads)

    def say(self, *texts: str) -> None:
        """Print sentences unless --quiet, wrapped on a terminal."""
        if self.quiet:
            return
        for text in texts:
            text = wrapped(text, terminal_width()) if is_terminal(self._stream) else text
            print(text, file=self._stream, flush=True)

    def detail(self, *texts: str) -> None:
        """Print lines with --verbose."""
        if self.verbose:
            self.say(*texts)

    def table(self, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Print an aligned table unless --quiet; nothing if it has no rows."""
        if rows and not self.quiet:
            top, lines = aligned(header, rows, terminal_width() if is_terminal(self._stream) else None)
            top = [paint(line, "bold", self._stream) for line in top]
            print("\n".join([*top, *lines]), file=self._stream, flush=True)

    def warn(self, *texts: str) -> None:
        """Print warnings on standard error unless --quiet."""
        for text in texts if not self.quiet else ():
            warn(text)

    def warn_of_all(self, texts: Sequence[str]) -> None:
        """Print warnings; of more than three that differ in numbers only, the first and the count of the others.

        The machine-readable report has all of them.
        """
        alike: dict[str, list[str]] = {}
        for text in texts:
            alike.setdefault(re.sub(r"\d+", "0", text), []).append(text)
        for first, *others in alike.values():
            if len(others) < 3:
                self.warn(first, *others)
            else:
                self.warn(f"{first} The same of {counted(len(others), 'others')}.")

    def wrote(self, *places: object) -> None:
        """Print the places of written results."""
        if not self.quiet:
            for place in places:
                line = f"Wrote {place}"
                if not isinstance(place, Path) and is_terminal(self._stream):  # paths are copied
                    line = wrapped(line, terminal_width())
                print(line.replace("Wrote", paint("Wrote", "green", self._stream), 1), file=self._stream, flush=True)

    def wrote_page(self, folder: Path) -> None:
        """Print the place of a written folder, and that of the page in it."""
        self.wrote(folder)
        if not self.quiet:  # not wrapped, so that it can be copied
            print(f"Open {(folder / 'report.html').absolute()} in a browser.", file=self._stream, flush=True)

    def begin_compilation(self, work: str) -> None:
        """Expect compilation, before large imports: processes begin at once if nothing was ever compiled."""
        from groma.compilation import ahead

        ahead.begin(work, self._announce_compilation, self.threads)

    def expect_compilation(self, work: str) -> None:
        """Announce compilation if the work needs any, and let other processes help with it.

        Nothing is printed, and no process started, if everything is compiled.
        """
        from groma.compilation import ahead

        ahead.expect(work, self._announce_compilation, self.threads)

    def _announce_compilation(self) -> None:
        if not self.quiet and can_rewrite(sys.stderr):
            sys.stderr.write("\r\x1b[K")  # the line of progress
        if (folder := sys.modules.get("groma._kernels.folder")) is not None and folder.is_own():
            self.say(
                "Compiling for this machine, in every run, because there is no folder to keep compiled code in: set "
                "NUMBA_CACHE_DIR to one that can be written."
            )
        else:
            self.say("First run: compiling for this machine. Later runs start at once.")

    def progress(self) -> Progress:
        """Return the progress of an adjustment, shown by :class:`groma.cli.shared.progress.Line`."""
        return Progress(self.quiet)

    def expect_stages(self, *names: str) -> None:
        """Declare the stages, so that they are numbered; only the first call counts."""
        if not self._plan.names:
            self._plan = Plan(names)

    def stages(self) -> Stages:
        """Return the progress of a pipeline of named stages, numbered if they were declared.

        With --verbose the time of every stage is printed.
        """
        return Stages(self.quiet, self._plan, finished=self.detail if self.verbose else None)


def warn(text: str) -> None:
    """Print a warning on standard error."""
    complain("warning:", text, "yellow")


def complain(what: str, text: str, style: Style) -> None:
    """Print a sentence and its kind on standard error, wrapped on a terminal."""
    line = f"{what} {text}"
    if is_terminal(sys.stderr):
        line = wrapped(line, terminal_width()).replace(what, paint(what, style, sys.stderr), 1)
    print(line, file=sys.stderr, flush=True)
