# SPDX-License-Identifier: BSD-3-Clause
"""JSON documents: finite numbers, bounded depth, and values of the expected type.

Every function takes the place where a value stands, for the message, such as ``path, camera 3``.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np

from groma._typing import FloatArray
from groma.bounded.content import read_content
from groma.bounded.text import shown
from groma.errors import FileFormatError

_Kind = TypeVar("_Kind", dict[str, Any], list[Any], str)
_WORDS = {dict: "an object {...}", list: "a list [...]", str: "a text"}
#: Longest text that is taken for a name, characters (cost: length of a message).
_LONGEST_NAME = 4096
#: Numbers from here on are taken for infinite.
_LARGEST_NUMBER = 1e300


def read_document(path: str | os.PathLike[str]) -> Any:
    """Return what a JSON file holds: dictionaries, lists, texts, numbers.

    Raises
    ------
    FileFormatError
        If it is not JSON, nested too deeply, or holds NaN or infinite numbers by name.
    """

    def refuse(word: str) -> NoReturn:
        raise FileFormatError(f"{path}: expected finite numbers; got {word}. Correct the file.")

    try:
        return json.loads(read_content(path).decode("utf-8-sig"), parse_constant=refuse)
    except RecursionError as error:
        raise FileFormatError(f"{path}: its lists and objects are nested too deeply. Correct the file.") from error
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise FileFormatError(f"{path} is not JSON from {where} on: {error.msg}. Fetch or write it again.") from error
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path} is not JSON: it is not a text file. Check the path.") from error
    except ValueError as error:  # whole numbers of thousands of digits
        raise FileFormatError(f"{path} holds a number that is too long ({error}). Correct the file.") from error


def begins_with(head: bytes, mark: bytes) -> bool:
    """Whether the first bytes of a file are those of a document that starts with the given ``{`` or ``[``."""
    return head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(mark)


def names_early(path: Path, head: bytes, mark: bytes, *names: str) -> bool:
    """Whether a document that starts with ``mark`` has one of the names in quotes in its first 64 kB."""
    if not begins_with(head, mark):
        return False
    with path.open("rb") as file:
        start = file.read(1 << 16)
    return any(f'"{name}"'.encode() in start for name in names)


def of_kind(value: Any, kind: type[_Kind], place: object) -> _Kind:
    """Return a value if it is of the given type (dictionary, list or text); else raise FileFormatError.

    A text is one that can be written again, of bounded length.
    """
    if not isinstance(value, kind):
        raise FileFormatError(f"{place}: expected {_WORDS[kind]}; got {_seen(value)}. Correct the file.")
    if isinstance(value, str) and (len(value) > _LONGEST_NAME or not _is_written(value)):
        raise FileFormatError(f"{place}: expected a name; got {shown(value)}. Correct the file.")
    return value


def member(holder: dict[str, Any], name: str, kind: type[_Kind], place: object) -> _Kind:
    """Return a member of a dictionary; FileFormatError if it is missing or of another kind."""
    if name not in holder:
        raise FileFormatError(f"{place}: expected {shown(name)}, which is missing. Is the file complete?")
    return of_kind(holder[name], kind, f"{place}, {shown(name)}")


def number(holder: dict[str, Any], name: str, place: object, default: float | None = None) -> float:
    """Return a finite number out of a dictionary; where it is missing, the default if there is one."""
    if name not in holder and default is not None:
        return default
    value = holder.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < _LARGEST_NUMBER:
        raise FileFormatError(f"{place}: expected {shown(name)}, a finite number; got {_seen(value)}. Correct it.")
    return float(value)


def size(holder: dict[str, Any], names: tuple[str, str], place: object) -> tuple[int, int]:
    """Return width and height of an image, whole numbers between 1 and a million."""
    found = [number(holder, name, place) for name in names]
    for name, value in zip(names, found, strict=True):
        if not (1 <= value <= 1e6 and value == math.floor(value)):
            raise FileFormatError(
                f"{place}: expected {shown(name)}, a size in pixels; got {value:g}. Correct the file."
            )
    return int(found[0]), int(found[1])


def table(rows: Sequence[Any], shape: tuple[int, ...], place: object) -> FloatArray:
    """Return lists of numbers as an array (N, *shape); FileFormatError if one is not finite or has another length."""
    if not len(rows):
        return np.zeros((0, *shape))
    try:
        found = np.array(rows)
    except (ValueError, OverflowError):  # rows of different lengths
        found = np.zeros(0)
    if found.dtype.kind not in "iuf" or found.shape != (len(rows), *shape) or not np.isfinite(found).all():
        words = " x ".join(map(str, shape)) if shape else "single"
        raise FileFormatError(f"{place}: expected {words} finite numbers; got {_seen(_odd_row(rows, shape))}.")
    return found.astype(np.float64)


def _odd_row(rows: Sequence[Any], shape: tuple[int, ...]) -> Any:
    """Return the first row of another form."""
    for row in rows:
        try:
            found = np.array(row)
        except (ValueError, OverflowError):
            return row
        if found.dtype.kind not in "iuf" or found.shape != shape or not np.isfinite(found).all():
            return row
    return rows[0]


def _is_written(text: str) -> bool:
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return "\0" not in text


def _seen(value: Any) -> str:
    if value is None:
        return "nothing"
    text = repr(value) if not isinstance(value, dict | list) or len(value) < 20 else f"{type(value).__name__} of many"
    return text[:60] + ("..." if len(text) > 60 else "")
