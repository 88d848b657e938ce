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


def aligned(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table, its header first: names to the left, numbers to the right.

    Columns in which no row has anything are left out.
    """
    shown = [column for column in range(len(header)) if column == 0 or any(row[column] for row in rows)]
    cells = [[line[column] for column in shown] for line in (header, *rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return [
        (_GAP + _GAP.join([first.ljust(widths[0]), *map(str.rjust, rest, widths[1:])])).rstrip()
        for first, *rest in cells
    ]
