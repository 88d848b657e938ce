# SPDX-License-Identifier: BSD-3-Clause
"""Measured distances from a text file: ``name name distance sigma`` a line, between control points or images."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray
from groma.bounded.text import finite, read_lines, shown
from groma.errors import FileFormatError
from groma.io.reading import existing, reading
from groma.io.survey.positions import split


@dataclass(frozen=True, eq=False)
class DistancesFile:
    """Distances as a file holds them."""

    #: (N,) names of what each is between.
    first: tuple[str, ...]
    second: tuple[str, ...]
    #: (N,) distance and its standard deviation, NaN where the file says nothing.
    distance: FloatArray
    sigma: FloatArray
    #: Where they come from, for messages.
    source: str


def read_distances(path: str | os.PathLike[str]) -> DistancesFile:
    """Read measured distances; see the module for the layout.

    Raises
    ------
    FileFormatError
        If a line is not of that form, or a distance is not positive.
    """
    place = existing(path)
    first, second, numbers = [], [], []
    with reading(place, "file of distances"):
        for line_number, line in read_lines(place):
            where, words = f"{place}, line {line_number}", split(line)
            if len(words) not in (3, 4):
                raise FileFormatError(f"{where}: expected name name distance sigma; got {shown(line)}.")
            if not numbers and not _is_number(words[2]):
                continue  # a header
            found = finite(words[2:], where, "a distance and its standard deviation")
            if min(found) <= 0.0:
                raise FileFormatError(f"{where}: a distance and its standard deviation must be positive; got {found}.")
            first.append(words[0])
            second.append(words[1])
            numbers.append((found[0], found[1] if len(found) > 1 else float("nan")))
    if not numbers:
        raise FileFormatError(f"{place} holds no distance. Expected lines of name name distance sigma.")
    table = np.array(numbers)
    return DistancesFile(tuple(first), tuple(second), table[:, 0], table[:, 1], str(place))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


__all__ = ["DistancesFile", "read_distances"]
