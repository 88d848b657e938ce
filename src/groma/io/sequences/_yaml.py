# SPDX-License-Identifier: BSD-3-Clause
"""The part of YAML that calibrations are written in: scalars and lists of numbers, under keys."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from groma._typing import FloatArray
from groma.bounded.text import finite, read_lines
from groma.errors import FileFormatError


def yaml_entries(path: Path) -> dict[str, str]:
    """Return scalars and flow lists by key, whatever they are nested in; a matrix's ``data`` as ``name.data``."""
    entries: dict[str, list[str]] = {}
    key, parent = None, ""  # of a list that goes on, and of a matrix
    for _, line in read_lines(path):
        if key is None:
            name, colon, value = line.partition(":")
            name, value = name.strip(), value.strip()
            if not colon or not name:
                continue
            if not value or value.startswith("!!"):
                parent = name
                continue
            name = f"{parent}.data" if name == "data" else name
            if name in entries and name in ("intrinsics", "camera_matrix.data"):
                raise FileFormatError(f"{path} holds several cameras; expected one. Remove the others.")
            entries[name] = [value]
            key = name if "[" in value else None
        else:
            entries[key].append(line)
        if "]" in line:
            key = None
    return {name: " ".join(parts).strip(" '\"") for name, parts in entries.items()}


def yaml_numbers(entries: dict[str, str], key: str, path: Path) -> FloatArray:
    """Return the numbers of a list in the entries of a file.

    Raises
    ------
    FileFormatError
        If it is not there, or is no list of finite numbers.
    """
    if key not in entries:
        raise FileFormatError(f"{path} has no entry {key}. Add it.")
    words = entries[key].partition("[")[2].partition("]")[0].replace(",", " ").split()
    return np.array(finite(words, f"{path}, {key}", "a list of finite numbers"))
