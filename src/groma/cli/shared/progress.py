# SPDX-License-Identifier: BSD-3-Clause
"""Progress on standard error: a line that is rewritten on a terminal, a line every ten seconds elsewhere."""

import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, Self

from groma._counted import duration
from groma.cli.shared.style import can_rewrite, has_colours, paint, terminal_width

#: Seconds between two lines where lines cannot be rewritten; characters of a full bar and of the shortest.
PAUSE, BAR, SHORT_BAR = 10.0, 20, 6
#: Seconds of a stage before its remaining time is shown.
_EARLY = 1.0
_ERASE = "\r\x1b[K"


class Line:
    """One line on a terminal, erased at the end; a line every ten seconds in a pipe, a file or a dumb terminal."""

    def __init__(self, quiet: bool) -> None:
        self._rewrites = not quiet and can_rewrite(sys.stderr)
        self._is_heard = not quiet
        self._last = time.monotonic()

    def _show(self, head: str, parts: str = "", share: float | None = None) -> None:
        if self._rewrites:
            sys.stderr.write(f"{_ERASE}{screen_line(head, parts, share, terminal_width())}")
            sys.stderr.flush()
        elif self._is_heard and time.monotonic() - self._last >= PAUSE:
            self._last = time.monotonic()
            print(f"  {head}  {parts}".rstrip(), file=sys.stderr, flush=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self._wipe()

    def _wipe(self) -> None:
        if self._rewrites:
            sys.stderr.write(_ERASE)
            sys.stderr.flush()


class Progress(Line):
    """A callback for the progress events of an adjustment."""

    def __call__(self, event: Any) -> None:
        """Show one event: iteration, limit and cost."""
        self._show("adjusting", f"step {event.iteration} of at most {event.max_iterations}, cost {event.cost:.6g}")


class Plan:
    """The declared stages by name; a name may occur twice, and stages may be repeated."""

    def __init__(self, names: Sequence[str] = ()) -> None:
        self.names = tuple(names)
        self._at = self._furthest = -1
        self._round = 1

    def label(self, name: str) -> str:
        """Return for example ``stage 3 of 12: finding segments`` for a new stage; only its name if undeclared."""
        later = [place for place, other in enumerate(self.names) if other == name]
        if not later:
            return name
        place = next((place for place in later if place > self._at), later[-1])
        if place < self._at:
            self._round += 1
        if place > self._furthest:
            self._furthest, self._round = place, 1
        self._at = place
        again = f", round {self._round}" if self._round > 1 else ""
        return f"stage {place + 1} of {len(self.names)}{again}: {name}"


class Stages(Line):
    """A callback for stages: name, number of parts done and in total."""

    def __init__(self, quiet: bool, plan: Plan, finished: Callable[[str], None] | None = None) -> None:
        super().__init__(quiet)
        self._plan = plan
        self._finished = finished
        self._stage = self._label = ""
        self._since = time.perf_counter()
        #: Start time and number of parts from which the remaining time is estimated.
        self._from = self._since, 0
        self._compiled = _functions_compiled()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show a stage."""
        compiled = _functions_compiled()
        if stage != self._stage:
            self._leave()
            self._stage, self._label = stage, self._plan.label(stage)
            self._from = self._since, done
        elif compiled != self._compiled or done < self._from[1]:
            # Compilation does not recur: estimate the remaining time from here on.
            self._from = time.perf_counter(), done
        self._compiled = compiled
        begin, first = self._from
        parts = parts_done(stage, done, total, time.perf_counter() - begin, first)
        share = done / total if total > 1 and not _has_steps(stage) else None
        self._show(self._label, parts, share)

    def __exit__(self, *raised: object) -> None:
        """Leave the last stage."""
        if raised[0] is None:
            self._leave()
        super().__exit__(*raised)

    def _leave(self) -> None:
        now = time.perf_counter()
        if self._stage and self._finished is not None:
            self._wipe()
            self._finished(f"  {self._stage}: {now - self._since:.1f} s")
        self._since = now


def parts_done(stage: str, done: int, total: int, seconds: float, first: int = 0) -> str:
    """Return the progress of a stage in words; empty without parts. The parts after ``first`` took ``seconds``.

    The steps of an adjustment, which ends at convergence, give no remaining time.
    """
    if _has_steps(stage):
        return f"step {done} of at most {total}" if done else ""
    if total <= 1:
        return f"{done:,}" if total == 0 and done else ""
    told = first < done < total and seconds > _EARLY
    return f"{done:,}/{total:,}" + (f", {duration(seconds * (total - done) / (done - first))} left" if told else "")


def _functions_compiled() -> tuple[int, ...]:
    """Return counts that change when this process compiles a function or waits for another process to do so."""
    cache = sys.modules.get("groma._kernels.cache")
    return () if cache is None else (cache.counts.missed, cache.counts.compiled, cache.counts.unsaved)


def _has_steps(stage: str) -> bool:
    return stage.startswith("adjusting")


def screen_line(head: str, parts: str, share: float | None, width: int) -> str:
    """Return a line that fits the terminal: the stage, a bar if there is room, and the progress."""
    room = width - 1
    bar = min(BAR, room - len(f"  {head}  []  {parts}")) if share is not None else 0
    if bar < SHORT_BAR or share is None:
        line = f"  {head}  {parts}".rstrip()
        return line if len(line) <= room else f"  {head}  {parts.partition(',')[0]}".rstrip()[:room]
    filled = int(bar * min(max(share, 0.0), 1.0))
    full, empty = ("━", "━") if has_colours(sys.stderr) and _can_say("━") else ("#", ".")
    drawn = paint(full * filled, "green", sys.stderr) + paint(empty * (bar - filled), "dim", sys.stderr)
    return f"  {head}  [{drawn}]  {parts}".rstrip()


def _can_say(text: str) -> bool:
    try:
        text.encode(sys.stderr.encoding or "ascii")
    except UnicodeEncodeError:
        return False
    return True
