# SPDX-License-Identifier: BSD-3-Clause
"""Text on a terminal: colours, tables, wrapped lines."""

import os
import re
import shutil
import textwrap
from collections.abc import Sequence
from typing import Literal, TextIO

Style = Literal["bold", "dim", "red", "green", "yellow", "cyan"]
_CODES: dict[Style, int] = {"bold": 1, "dim": 2, "red": 31, "green": 32, "yellow": 33, "cyan": 36}
#: Between the columns of a table, and before its first.
_GAP = "  "
#: Of the header of a table.
_MOST_LINES = 3


def is_terminal(stream: TextIO | None) -> bool:
    """Whether a stream is a terminal."""
    return stream is not None and stream.isatty()


def can_rewrite(stream: TextIO | None) -> bool:
    """Whether lines of a stream can be rewritten: a terminal, unless TERM is dumb."""
    return is_terminal(stream) and os.environ.get("TERM") != "dumb"


def has_colours(stream: TextIO | None) -> bool:
    """Whether a stream shows colours: a terminal, unless NO_COLOR is set or TERM is dumb."""
    return can_rewrite(stream) and not os.environ.get("NO_COLOR")


def paint(text: str, style: Style, stream: TextIO | None) -> str:
    """Return the text in a style; unchanged if the stream shows no colours."""
    return f"\x1b[{_CODES[style]}m{text}\x1b[0m" if text and has_colours(stream) else text


def terminal_width() -> int:
    """Return the number of columns of the terminal."""
    return shutil.get_terminal_size().columns


def wrapped(text: str, width: int) -> str:
    """Return the text wrapped between words, but not before a percent sign; continuation lines indented."""
    lines = []
    for line in text.replace(" %", "\0%").split("\n"):
        indent = re.match(" *", line)[0]  # type: ignore[index]
        lines += textwrap.wrap(
            line, max(width, 20), subsequent_indent=f"{indent}  ", break_long_words=False, break_on_hyphens=False
        ) or [""]
    return "\n".join(lines).replace("\0%", " %")


def aligned(
    header: Sequence[str], rows: Sequence[Sequence[str]], width: int | None = None
) -> tuple[list[str], list[str]]:
    """Return the header lines and the body lines of a table: first column left-aligned, the others right-aligned.

    Empty columns are left out. The header of a table wider than ``width`` is wrapped into as few lines as make it fit.
    """
    shown = [column for column in range(len(header)) if column == 0 or any(row[column] for row in rows)]
    cells = [[row[column] for column in shown] for row in rows]
    least = [max(map(len, column)) for column in zip(*cells, strict=True)]
    names, height = [header[column] for column in shown], 1
    while True:
        heads = [_broken(name, room, height) for name, room in zip(names, least, strict=True)]
        widths = [max(room, *map(len, head)) for room, head in zip(least, heads, strict=True)]
        if width is None or sum(widths) + len(_GAP) * len(widths) <= width or height >= _MOST_LINES:
            break
        height += 1

    def line(parts: Sequence[str]) -> str:
        first, *rest = parts
        return (_GAP + _GAP.join([first.ljust(widths[0]), *map(str.rjust, rest, widths[1:])])).rstrip()

    return [line(parts) for parts in zip(*heads, strict=True)], [line(parts) for parts in cells]


def _broken(head: str, room: int, height: int) -> list[str]:
    """Return the head of a column in ``height`` lines, as narrow as possible, padded with empty lines at the top."""
    lines = [head]
    for width in range(max(room, 1), len(head) + 1):
        lines = textwrap.wrap(head, width, break_long_words=False, break_on_hyphens=False)
        if len(lines) <= height:
            break
    return [""] * (height - len(lines)) + lines
