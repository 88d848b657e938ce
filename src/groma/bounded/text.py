# SPDX-License-Identifier: BSD-3-Clause
"""Lines, words and numbers of text files, read one by one, of bounded length; every number finite."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Iterable, Iterator, Sequence

from groma.bounded.content import READING, read_content
from groma.errors import FileFormatError


def read_text(path: str | os.PathLike[str]) -> str:
    """Return the text of a file that may be compressed; see :func:`groma.bounded.content.read_content`."""
    return read_content(path).decode("utf-8")


def read_lines(path: str | os.PathLike[str]) -> Iterator[tuple[int, str]]:
    """Yield the lines of a text file that hold something, with their numbers; ``#`` starts a comment.

    Raises
    ------
    FileFormatError
        If a line is longer than any that holds numbers.
    """
    for number, line in enumerate(io.StringIO(read_text(path)), 1):
        if len(line) > READING.line:
            raise FileFormatError(
                f"{path}, line {number}: it has {len(line)} characters; expected at most {READING.line}. Is it a text "
                "file with line ends?"
            )
        if bare := line.partition("#")[0].strip():
            yield number, bare


def read_words(path: str | os.PathLike[str]) -> Iterator[tuple[int, list[str]]]:
    """Yield the words of the lines of :func:`read_lines`, separated by white space."""
    for number, line in read_lines(path):
        yield number, line.split()


def finite(words: Iterable[str], place: object, expected: str = "finite numbers") -> list[float]:
    """Return words as finite numbers.

    Parameters
    ----------
    words : iterable of str
        The words.
    place : object
        Where they stand, for the message, such as ``path, line 3``.
    expected : str
        What should stand there.

    Raises
    ------
    FileFormatError
        If one of them is not a number, or not finite.
    """
    words = list(words)
    try:
        found = list(map(float, words))
    except ValueError:
        found = [math.nan]
    if not all(map(math.isfinite, found)):
        wrong = next(word for word in words if not (is_number(word) and math.isfinite(float(word))))
        raise FileFormatError(f"{place}: expected {expected}; got {shown(wrong)}. Correct the file.")
    return found


def is_number(word: str) -> bool:
    """Whether a word is a number for Python, NaN and infinity included."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def whole(word: str, place: object, expected: str = "a whole number") -> int:
    """Return a word as a whole number of 64 bits, or raise FileFormatError; see :func:`finite`."""
    try:
        value = int(word) if len(word) <= 20 else None
    except ValueError:
        value = None
    if value is None or abs(value) >= 2**63:
        raise FileFormatError(f"{place}: expected {expected}; got {shown(word)}. Correct the file.")
    return value


def shown(word: str | bytes | Sequence[str]) -> str:
    """Return content of a file for a message: quoted, and cut if long."""
    return repr(word[:40]) + ("..." if len(word) > 40 else "")
