# SPDX-License-Identifier: BSD-3-Clause
"""How text looks: colours where a terminal shows them and they are wanted, tables, lines as wide as the screen."""

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
    """Tell whether somebody looks at a stream."""
    return stream is not None and stream.isatty()


def can_rewrite(stream: TextIO | None) -> bool:
    """Tell whether a line of a stream can be written anew: a terminal, unless TERM is dumb."""
    return is_terminal(stream) and os.environ.get("TERM") != "dumb"


def has_colours(stream: TextIO | None) -> bool:
    """Tell whether a stream shows colours: a terminal, unless NO_COLOR is set or TERM is dumb."""
    return can_rewrite(stream) and not os.environ.get("NO_COLOR")


def paint(text: str, style: Style, stream: TextIO | None) -> str:
    """Return the text in a style, or as it is where the stream shows none."""
    return f"\x1b[{_CODES[style]}m{text}\x1b[0m" if text and has_colours(stream) else text


def terminal_width() -> int:
    """Return how many characters a line of the terminal holds."""
    return shutil.get_terminal_size().columns


def wrapped(text: str, width: int) -> str:
    """Return the text with its lines broken between words; what follows a break stands deeper than its line."""
    lines = []
    for line in text.split("\n"):
        indent = re.match(" *", line)[0]  # type: ignore[index]
        lines += textwrap.wrap(
            line, max(width, 20), subsequent_indent=f"{indent}  ", break_long_words=False, break_on_hyphens=False
        ) or [""]
    return "\n".join(lines)


def aligned(
    header: Sequence[str], rows: Sequence[Sequence[str]], width: int | None = None
) -> tuple[list[str], list[str]]:
    """Return the lines of a table, those of its header apart: names to the left, numbers to the right.

    Columns in which no row has anything are left out. The header of a table wider than ``width`` is broken between
    words, into as few lines as make it fit.
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
    """Return the words of a column's head in so many lines, the first ones empty, no wider than need be."""
    lines = [head]
    for width in range(max(room, 1), len(head) + 1):
        lines = textwrap.wrap(head, width, break_long_words=False, break_on_hyphens=False)
        if len(lines) <= height:
            break
    return [""] * (height - len(lines)) + lines
