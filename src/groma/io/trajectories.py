# SPDX-License-Identifier: BSD-3-Clause
"""Trajectories in the formats of TUM, KITTI, EuRoC and Redwood, plain or compressed by gzip.

=========  =====================================================================  =================================
``tum``    ``time tx ty tz qx qy qz qw``, separated by spaces                     seconds; world_from_cam
``kitti``  12 numbers, the rows of the 3x4 matrix world_from_cam                  no time: the number of the line
``euroc``  ``time, px, py, pz, qw, qx, qy, qz`` and more, separated by commas     nanoseconds; world_from_body
``log``    a line of three whole numbers, then the rows of the 4x4 matrix         no time: the number of the pose;
           world_from_cam (Redwood, Open3D, Tanks and Temples)                    world_from_cam
=========  =====================================================================  =================================

``#`` starts a comment. All of them hold where the camera (or body) is, the inverse of the ``cam_from_world`` of scenes.
"""

from __future__ import annotations

import os
from array import array
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.bounded.names import existing
from groma.bounded.text import finite, read_lines
from groma.errors import FileFormatError, InputError, ShapeError
from groma.geometry import se3
from groma.io.atomic import atomic_output
from groma.io.pose_conventions import EUROC, KITTI, TUM
from groma.io.reading import reading
from groma.scene.table import Table, column

#: Lines of a pose in the format .log: its numbers, and a matrix of 4x4.
_LOG_LINES = 5

#: Lines with content, and their numbers.
NumberedLines = Iterable[tuple[int, str]]


@dataclass(frozen=True, eq=False)
class Trajectory(Table, noun="pose"):
    """Poses over time. Note the direction: world_from_cam, as trajectory files hold it."""

    #: (N,) seconds.
    timestamps: FloatArray = column(np.float64)
    #: (N, 7) pose [qx qy qz qw tx ty tz]; the translation is the camera centre.
    world_from_cam: FloatArray = column(np.float64, 7)

    @property
    def cam_from_world(self) -> FloatArray:
        """(N, 7) poses in the direction that scenes use."""
        return se3.inverse(self.world_from_cam)


@dataclass(frozen=True)
class TrajectoryFormat:
    """How trajectories are written as text, one pose a line."""

    name: str
    #: Given the first line that holds something: whether a file may be of this format.
    fits: Callable[[str], bool]
    #: Given the path, for messages, and the lines. Whatever it raises becomes a FileFormatError.
    read: Callable[[Path, NumberedLines], Trajectory]
    #: Returns the text.
    write: Callable[[Trajectory], str]
    #: Whether the lines hold times; without, callers may give them.
    has_times: bool = True


_FORMATS: dict[str, TrajectoryFormat] = {}


def register_trajectory_format(trajectory_format: TrajectoryFormat) -> TrajectoryFormat:
    """Make a format known to :func:`read_trajectory` and :func:`write_trajectory`; return it.

    Raises
    ------
    InputError
        If the name belongs to another format.
    """
    name = trajectory_format.name
    if _FORMATS.get(name, trajectory_format).read.__module__ != trajectory_format.read.__module__:
        raise InputError(f"A trajectory format named {name!r} is registered already. Choose another name.")
    _FORMATS[name] = trajectory_format
    return trajectory_format


def read_trajectory(
    path: str | os.PathLike[str], format: str = "auto", timestamps: npt.ArrayLike | None = None
) -> Trajectory:
    """Read a trajectory; quaternions are scaled to length one and matrices replaced by the nearest rotation.

    Parameters
    ----------
    path : path
        The file; it may be compressed by gzip.
    format : str
        ``tum``, ``kitti``, ``euroc`` or ``log``; ``auto`` decides by the first line with numbers.
    timestamps : (N,) float, optional
        Times of the poses of a KITTI file, seconds. Without them the pose in line i has time i.

    Returns
    -------
    Trajectory
        The poses in the order of the file.

    Raises
    ------
    InputError
        If there is no such file or format.
    FileFormatError
        If a line does not hold the numbers of its format, or a quaternion or matrix is not a rotation.
    """
    if format not in ("auto", *_FORMATS):
        raise InputError(f"Unknown trajectory format {format!r}. Use auto, {', '.join(_FORMATS)}.")
    place = existing(path)
    with reading(place, "trajectory"):
        rows = read_lines(place)
        if (first := next(rows, None)) is None:
            raise FileFormatError(f"{place} holds no pose. Expected one in each line, of {', '.join(_FORMATS)}.")
        chosen = _recognise(place, *first) if format == "auto" else _FORMATS[format]
        read = chosen.read(place, chain([first], rows))
        if timestamps is None or chosen.has_times:
            return read
        times = np.asarray(timestamps, float)
        if times.shape != (len(read),):
            raise ShapeError(f"timestamps must have shape ({len(read)},), one per pose; got {times.shape}.")
        return read.replace(timestamps=times)


def write_trajectory(
    trajectory: Trajectory, path: str | os.PathLike[str], format: str = "tum", force: bool = False
) -> None:
    """Write a trajectory, whole or not at all.

    Numbers are written so that they read back exactly, apart from the times: KITTI has none, EuRoC counts nanoseconds.

    Raises
    ------
    InputError
        If the format is unknown.
    OutputError
        If ``path`` exists already or cannot be written.
    """
    if format not in _FORMATS:
        raise InputError(f"Unknown trajectory format {format!r}. Use {', '.join(_FORMATS)}.")
    text = _FORMATS[format].write(trajectory)
    with atomic_output(path, force) as draft:
        draft.write_text(text, encoding="utf-8")


def read_tum(path: str | os.PathLike[str]) -> Trajectory:
    """Read a trajectory in TUM format; see :func:`read_trajectory`."""
    return read_trajectory(path, "tum")


def write_tum(trajectory: Trajectory, path: str | os.PathLike[str], force: bool = False) -> None:
    """Write a trajectory in TUM format; see :func:`write_trajectory`."""
    write_trajectory(trajectory, path, "tum", force)


def read_times(path: str | os.PathLike[str]) -> FloatArray:
    """Read times (N,), seconds, one a line, as they lie beside the poses of KITTI."""
    place = existing(path)
    with reading(place, "times"):
        return _numbers(place, read_lines(place), 1)[0][:, 0]


# ---------------------------------------------------------------------------------------------------------- Formats


def _words(line: str) -> list[str]:
    return line.split(",") if "," in line else line.split()


def _recognise(path: Path, number: int, line: str) -> TrajectoryFormat:
    for known in _FORMATS.values():
        if known.fits(line):
            return known
    raise FileFormatError(
        f"{path}, line {number}: expected 8 numbers (TUM), 12 (KITTI), 8 and more separated by commas (EuRoC) or 3 "
        f"before a matrix (.log); got {len(_words(line))} words. Pass the format if this is not the first pose."
    )


def _numbers(path: Path, rows: NumberedLines, count: int, more: bool = False) -> tuple[FloatArray, IntArray]:
    """Return the first ``count`` numbers of each row, (N, count), and the numbers of the lines."""
    table, lines = array("d"), array("q")
    for number, line in rows:
        words = _words(line)
        if len(words) != count and not (more and len(words) > count):
            raise FileFormatError(f"{path}, line {number}: expected {count} numbers, got {len(words)}.")
        table.extend(finite(words[:count], f"{path}, line {number}", f"{count} finite numbers"))
        lines.append(number)
    return np.array(table).reshape(-1, count), np.array(lines)


def _unit(path: Path, lines: IntArray, quaternions: FloatArray) -> FloatArray:
    with np.errstate(over="ignore"):
        length = np.linalg.norm(quaternions, axis=1)
    bad = np.flatnonzero(~((length > 0.5) & (length < 2)))
    if len(bad):
        raise FileFormatError(
            f"{path}, line {lines[bad[0]]}: the quaternion {quaternions[bad[0]].tolist()} is far from unit length."
        )
    return quaternions / length[:, None]


def _read_tum(path: Path, rows: NumberedLines) -> Trajectory:
    table, lines = _numbers(path, rows, 8)
    return Trajectory(table[:, 0], np.hstack([TUM.quaternions(_unit(path, lines, table[:, 4:])), table[:, 1:4]]))


def _read_euroc(path: Path, rows: NumberedLines) -> Trajectory:
    table, lines = _numbers(path, rows, 8, more=True)
    turned = EUROC.quaternions(_unit(path, lines, table[:, 4:]))
    return Trajectory(table[:, 0] * 1e-9, np.hstack([turned, table[:, 1:4]]))


def _read_kitti(path: Path, rows: NumberedLines) -> Trajectory:
    table, lines = _numbers(path, rows, 12)
    return _of_matrices(path, lines, table.reshape(-1, 3, 4))


def _read_log(path: Path, rows: NumberedLines) -> Trajectory:
    text = list(rows)
    if len(text) % _LOG_LINES:
        raise FileFormatError(f"{path}: expected {_LOG_LINES} lines for each pose; got {len(text)}. Is it cut off?")
    heads, lines = _numbers(path, text[::_LOG_LINES], 3)
    matrices = _numbers(path, (row for at, row in enumerate(text) if at % _LOG_LINES), 4)[0].reshape(-1, 4, 4)
    if (heads != np.floor(heads)).any():
        wrong = lines[(heads != np.floor(heads)).any(axis=1)][0]
        raise FileFormatError(f"{path}, line {wrong}: expected three whole numbers before each matrix.")
    if (matrices[:, 3] != [0.0, 0.0, 0.0, 1.0]).any():
        wrong = lines[(matrices[:, 3] != [0.0, 0.0, 0.0, 1.0]).any(axis=1)][0]
        raise FileFormatError(f"{path}, line {wrong + 4}: the last row of a pose is 0 0 0 1.")
    return _of_matrices(path, lines + 1, matrices[:, :3])


def _of_matrices(path: Path, lines: IntArray, matrices: FloatArray) -> Trajectory:
    """Return poses without times from world_from_cam, (N, 3, 4)."""
    # The nearest rotation: files hold six or seven digits.
    u, singular, vt = np.linalg.svd(matrices[:, :, :3])
    turned = u @ vt
    bad = np.flatnonzero((np.abs(singular - 1.0).max(axis=1, initial=0.0) > 0.01) | (np.linalg.det(turned) < 0))
    if len(bad):
        raise FileFormatError(f"{path}, line {lines[bad[0]]}: the first three columns are not a rotation.")
    poses = np.hstack([KITTI.quaternions(turned), matrices[:, :, 3]])
    return Trajectory(np.arange(len(poses), dtype=float), poses)


def _lines(table: FloatArray) -> str:
    return "".join(" ".join(map(repr, row)) + "\n" for row in table.tolist())


def _write_tum(trajectory: Trajectory) -> str:
    pose = trajectory.world_from_cam
    return _lines(np.hstack([trajectory.timestamps[:, None], pose[:, 4:], pose[:, :4]]))


def _write_kitti(trajectory: Trajectory) -> str:
    return _lines(se3.to_matrix(trajectory.world_from_cam)[:, :3].reshape(-1, 12))


def _write_log(trajectory: Trajectory) -> str:
    matrices = se3.to_matrix(trajectory.world_from_cam)
    return "".join(f"{number} {number} 0\n{_lines(matrix)}" for number, matrix in enumerate(matrices))


def _write_euroc(trajectory: Trajectory) -> str:
    pose = trajectory.world_from_cam
    times = [round(time * 1e9) for time in trajectory.timestamps.tolist()]
    rows = np.hstack([pose[:, 4:], pose[:, [3, 0, 1, 2]]]).tolist()
    body = (f"{time:d}," + ",".join(map(repr, row)) + "\n" for time, row in zip(times, rows, strict=True))
    return "#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w [],q_x [],q_y [],q_z []\n" + "".join(body)


for _format in (
    TrajectoryFormat("tum", lambda line: "," not in line and len(_words(line)) == 8, _read_tum, _write_tum),
    TrajectoryFormat(
        "kitti", lambda line: "," not in line and len(_words(line)) == 12, _read_kitti, _write_kitti, False
    ),
    TrajectoryFormat(
        "log",
        lambda line: len(_words(line)) == 3 and all(word.isdigit() for word in _words(line)),
        _read_log,
        _write_log,
        False,
    ),
    TrajectoryFormat("euroc", lambda line: "," in line and len(_words(line)) >= 8, _read_euroc, _write_euroc),
):
    register_trajectory_format(_format)
