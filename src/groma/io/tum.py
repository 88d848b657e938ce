# SPDX-License-Identifier: BSD-3-Clause
# ruff: noqa: RUF009 - column() is dataclasses.field() with metadata
"""Trajectories in TUM format: ``time tx ty tz qx qy qz qw`` per line, world_from_cam, ``#`` starts a comment."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from groma._typing import FloatArray
from groma.errors import FileFormatError
from groma.io._atomic import atomic_output
from groma.io._reading import existing, reading
from groma.scene._table import Table, column


@dataclass(frozen=True, eq=False)
class Trajectory(Table):
    """Poses over time. Note the direction: world_from_cam, as trajectory files hold it."""

    noun: ClassVar[str] = "pose"
    #: (N,) seconds.
    timestamps: FloatArray = column(np.float64)
    #: (N, 7) pose [qx qy qz qw tx ty tz]; the translation is the camera centre.
    world_from_cam: FloatArray = column(np.float64, 7)


def read_tum(path: str | os.PathLike[str]) -> Trajectory:
    """Read a trajectory; quaternions are scaled to length one.

    Raises
    ------
    FileFormatError
        If a line does not hold eight finite numbers or a quaternion is zero.
    """
    place = existing(path)
    with reading(place, "TUM trajectory"):
        rows = []
        for number, line in enumerate(place.read_text(encoding="utf-8").splitlines(), start=1):
            words = line.partition("#")[0].split()
            if words and len(words) != 8:
                raise FileFormatError(f"{place}, line {number}: expected 8 numbers, got {len(words)}.")
            if words:
                rows.append([float(word) for word in words])
        table = np.array(rows, float).reshape(-1, 8)
        length = np.linalg.norm(table[:, 4:], axis=1)
        if not ((length > 0.5) & (length < 2)).all():
            row = int(np.flatnonzero(~((length > 0.5) & (length < 2)))[0])
            raise FileFormatError(
                f"{place}: pose {row} has the quaternion {table[row, 4:].tolist()}, far from unit length."
            )
        return Trajectory(table[:, 0], np.hstack([table[:, 4:] / length[:, None], table[:, 1:4]]))


def write_tum(trajectory: Trajectory, path: str | os.PathLike[str], force: bool = False) -> None:
    """Write a trajectory; numbers are written so that they read back exactly."""
    table = np.hstack(
        [trajectory.timestamps[:, None], trajectory.world_from_cam[:, 4:], trajectory.world_from_cam[:, :4]]
    )
    with atomic_output(path, force) as draft:
        draft.write_text("".join(" ".join(map(repr, row)) + "\n" for row in table.tolist()))


__all__ = ["Trajectory", "read_tum", "write_tum"]
