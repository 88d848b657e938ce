# SPDX-License-Identifier: BSD-3-Clause
"""Folders of the KITTI odometry benchmark: rectified stereo pairs, ``calib.txt``, ``times.txt``, perhaps ``poses.txt``.

The grey cameras ``image_0`` and ``image_1`` are used if they are there, the colour cameras ``image_2`` and ``image_3``
otherwise. The reference is ``poses.txt`` in the folder, or ``poses/NN.txt`` beside the folder ``sequences`` that NN
lies in.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from groma._typing import FloatArray
from groma.bounded.text import finite, read_lines, read_words
from groma.errors import FileFormatError
from groma.io.reading import reading
from groma.io.sequences._calibration import from_opencv
from groma.io.sequences._reader import Entry, FileSequence, simple_sequence
from groma.io.sequences.layouts import Wishes
from groma.io.trajectories import Trajectory, read_trajectory

#: Frames a second where there is no ``times.txt`` (convention: as in the benchmark).
RATE = 10.0


def is_kitti(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return any((folder / name).is_dir() for name in ("image_0", "image_2"))


def open_kitti(folder: Path, wishes: Wishes) -> FileSequence:
    """Open a folder; see :func:`groma.io.sequences.open_sequence`."""
    calibration = wishes.calibration
    left, right = ("image_0", "image_1") if (folder / "image_0").is_dir() else ("image_2", "image_3")
    has_right = (folder / right).is_dir()
    matrices = projections(folder / "calib.txt") if (folder / "calib.txt").is_file() else {}
    projection, other = (matrices.get(f"P{name[-1]}") for name in (left, right))
    if projection is None and calibration is None:
        raise FileFormatError(f"{folder / 'calib.txt'} is missing or holds no P{left[-1]}. Add it, or pass camera=.")
    baseline = baseline_of(projection, other)
    warnings: list[str] = []
    if has_right and not (baseline is not None and baseline > 0):
        warnings.append(f"calib.txt says no baseline from {left} to {right}; only {left} is used.")
        has_right = False
    kind = wishes.selection.kind_of("stereo" if has_right else "mono")
    if calibration is None:
        assert projection is not None
        calibration = from_opencv(projection[[0, 1, 0, 1], [0, 1, 2, 2]])

    images = sorted(path for path in (folder / left).iterdir() if path.suffix.lower() in (".png", ".jpg", ".jpeg"))
    # The number in a name is the frame; without numbers, or with missing times, frames are counted.
    numbers = [int(path.stem) if path.stem.isdecimal() else row for row, path in enumerate(images)]
    count = max(numbers, default=-1) + 1
    times = _times(folder / "times.txt", count, warnings)
    rights = {path.name for path in (folder / right).iterdir()} if has_right else set()
    entries = [
        Entry(_time(times, number), path, right=folder / right / path.name if path.name in rights else None)
        for number, path in zip(numbers, images, strict=True)
    ]
    reference = _reference(folder, times, count if times is None else len(times), warnings)
    return simple_sequence(
        kind, wishes.selection.of(entries, warnings), calibration, reference, warnings, baseline=baseline
    )


def projections(path: Path) -> dict[str, FloatArray]:
    """Return the 3x4 matrices P0 to P3 of a ``calib.txt``."""
    with reading(path, "KITTI calibration"):
        found = {}
        for number, line in read_lines(path):
            name, _, values = line.partition(":")
            if (name := name.strip()) in ("P0", "P1", "P2", "P3"):
                numbers = finite(values.split(), f"{path}, line {number}", "12 finite numbers")
                found[name] = np.array(numbers).reshape(3, 4)
                if found[name][0, 0] <= 0:
                    raise FileFormatError(f"{path}, line {number}: expected a positive focal length; got {numbers[0]}.")
        return found


def baseline_of(left: FloatArray | None, right: FloatArray | None) -> float | None:
    """Return the distance between two cameras with these projections (3, 4), right of each other; None without both."""
    return None if left is None or right is None else float(left[0, 3] / left[0, 0] - right[0, 3] / right[0, 0])


def _times(path: Path, count: int, warnings: list[str]) -> list[float] | None:
    """Return at least ``count`` times, or None where there are none."""
    if not path.is_file():
        warnings.append(f"There is no times.txt; {RATE:g} frames a second are assumed.")
        return None
    with reading(path, "list of times"):
        times = [time for line, words in read_words(path) for time in finite(words, f"{path}, line {line}")]
        if len(times) < count:
            raise FileFormatError(f"expected {count} finite times, one per frame; got {len(times)}.")
    return times


def _time(times: list[float] | None, number: int) -> float:
    return number / RATE if times is None else times[number]


def _reference(folder: Path, times: list[float] | None, count: int, warnings: list[str]) -> Trajectory | None:
    resolved = folder.resolve()
    for path in (folder / "poses.txt", resolved.parent.parent / "poses" / f"{resolved.name}.txt"):
        if path.is_file():
            poses = read_trajectory(path, "kitti")
            if len(poses) > count:
                warnings.append(f"{path.name} holds {len(poses)} poses for {count} times; the rest is left out.")
                poses = poses.take(np.arange(count))
            return poses.replace(timestamps=np.array([_time(times, number) for number in range(len(poses))]))
    return None
