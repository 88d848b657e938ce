# SPDX-License-Identifier: BSD-3-Clause
"""Folders of the TUM RGB-D benchmark: ``rgb.txt`` and ``depth.txt``, or ``associations.txt``; ``groundtruth.txt``.

Colour and depth have times of their own. Pairs are taken from ``associations.txt`` if it is there; otherwise the pairs
nearest in time are joined first, each image once, up to 0.02 s apart. Depth images are registered to colour; 5000
stands for a metre.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from groma._typing import FloatArray
from groma.bounded.names import listed_file
from groma.bounded.text import finite, read_text, read_words
from groma.errors import FileFormatError, InputError
from groma.io.reading import reading
from groma.io.sequences._calibration import Calibration, find_calibration, from_opencv
from groma.io.sequences._reader import Entry, FileSequence, Preparation, simple_sequence
from groma.io.sequences.layouts import Wishes
from groma.io.trajectories import read_trajectory

#: Calibrations of the three colour cameras of the benchmark: fx, fy, cx, cy, k1, k2, p1, p2, k3.
FREIBURG = {
    "1": (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    "2": (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    "3": (535.4, 539.2, 320.1, 247.6),
}
#: Numbers in the format per metre.
DEPTH_SCALE = 5000.0
#: Largest difference in time of a pair, seconds (convention: as in the benchmark).
TOLERANCE = 0.02


def is_tum_rgbd(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return (folder / "rgb.txt").is_file() or (folder / "associations.txt").is_file()


def open_tum_rgbd(folder: Path, wishes: Wishes) -> FileSequence:
    """Open a folder; see :func:`groma.io.sequences.open_sequence`."""
    calibration = wishes.calibration or find_calibration(folder) or _freiburg(folder)
    warnings: list[str] = []
    kind = wishes.selection.kind_of("rgbd" if _has_depth(folder) else "mono")
    entries = wishes.selection.of(_entries(folder), warnings)
    truth = folder / "groundtruth.txt"
    reference = read_trajectory(truth, "tum") if truth.is_file() else None
    preparation = Preparation(depth_scale=wishes.depth_scale or DEPTH_SCALE)
    return simple_sequence(kind, entries, calibration, reference, warnings, preparation)


def pair_by_time(first: FloatArray, second: FloatArray, tolerance: float = TOLERANCE) -> list[tuple[int, int]]:
    """Return pairs of rows, nearest in time first, each row in one pair at most; in order of the first row."""
    if len(first) == 0 or len(second) == 0:
        return []
    order = np.argsort(second, kind="stable")
    place = np.searchsorted(second[order], first)
    # The two neighbours on either side: enough, because a taken neighbour leaves only farther ones.
    near = [np.clip(place + step, 0, len(second) - 1) for step in (-2, -1, 0, 1)]
    rows, columns = np.tile(np.arange(len(first)), len(near)), order[np.concatenate(near)]
    gaps = np.abs(first[rows] - second[columns])
    taken: set[int] = set()
    pairs: dict[int, int] = {}
    for candidate in np.argsort(gaps, kind="stable"):
        row, column = int(rows[candidate]), int(columns[candidate])
        if gaps[candidate] <= tolerance and row not in pairs and column not in taken:
            pairs[row] = column
            taken.add(column)
    return sorted(pairs.items())


def _freiburg(folder: Path) -> Calibration:
    """Return the calibration of the benchmark's camera that the folder's name says, or the first lines of its files."""
    found = re.search(r"(?:freiburg|fr)([123])(?!\d)", folder.resolve().name.lower())
    lists = [folder / name for name in ("rgb.txt", "depth.txt", "groundtruth.txt") if (folder / name).is_file()]
    for path in lists:
        with reading(path, "list of images"):
            found = found or re.match(r"(?:#.*\n)*?# file:.*freiburg([123])(?!\d)", read_text(path))
    if found is None:
        raise InputError(
            f"{folder} holds no camera, and neither its name nor the first lines of its files say which of the three "
            "of the benchmark it is. Pass one (--camera), such as '525 525 319.5 239.5', or put it into camera.txt."
        )
    return from_opencv(FREIBURG[found[1]], (640, 480))


def _has_depth(folder: Path) -> bool:
    return (folder / "depth.txt").is_file() or (folder / "associations.txt").is_file()


def _entries(folder: Path) -> list[Entry]:
    if (folder / "associations.txt").is_file():
        entries = []
        for number, words in _lines(folder / "associations.txt"):
            if len(words) != 4:
                raise FileFormatError(
                    f"{folder / 'associations.txt'}, line {number}: expected a time and a file, twice; got "
                    f"{len(words)} words."
                )
            pair = [_listed(folder / "associations.txt", number, part) for part in (words[:2], words[2:])]
            if "depth" in words[1] and "depth" not in words[3]:
                pair.reverse()
            (time, color), (_, depth) = pair
            entries.append(Entry(time, color, depth))
        return entries
    colors = _list(folder / "rgb.txt")
    depths = _list(folder / "depth.txt") if (folder / "depth.txt").is_file() else []
    pairs = dict(pair_by_time(np.array([time for time, _ in colors]), np.array([time for time, _ in depths])))
    return [
        Entry(time, path, depths[pairs[row]][1] if row in pairs else None) for row, (time, path) in enumerate(colors)
    ]


def _list(path: Path) -> list[tuple[float, Path]]:
    listed = []
    for number, words in _lines(path):
        if len(words) < 2:
            raise FileFormatError(f"{path}, line {number}: expected a time and a file; got {words}.")
        listed.append(_listed(path, number, words[:2]))
    return listed


def _listed(path: Path, number: int, words: list[str]) -> tuple[float, Path]:
    """Return the time and the file in two words of a line."""
    place = f"{path}, line {number}"
    return finite(words[:1], place, "a finite time")[0], listed_file(path.parent, words[1], place)


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    with reading(path, "list of images"):
        return list(read_words(path))
