# SPDX-License-Identifier: BSD-3-Clause
# ruff: noqa: RUF009 - column() is dataclasses.field() with metadata
"""Frames (a rig at one moment) and the images taken by them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.scene.table import Table, check_unique, column, text_column


@dataclass(frozen=True, eq=False)
class Frames(Table):
    """Where each rig was: one row per moment."""

    noun: ClassVar[str] = "frame"
    #: (F,) identifiers.
    ids: IntArray = column(np.int64)
    #: (F,) the rig.
    rig_idx: IntArray = column(np.int64, refers="rigs")
    #: (F, 7) pose [qx qy qz qw tx ty tz], unit quaternions, scene units.
    rig_from_world: FloatArray = column(np.float64, 7, world="poses")

    def _check(self) -> None:
        check_unique("Frames.ids", self.ids)


@dataclass(frozen=True, eq=False)
class Images(Table):
    """Images: a frame seen by one of its sensors."""

    noun: ClassVar[str] = "image"
    #: (N,) identifiers.
    ids: IntArray = column(np.int64)
    #: (N,) file names.
    names: tuple[str, ...] = text_column()
    #: (N,) the camera (calibration).
    camera_idx: IntArray = column(np.int64, refers="cameras")
    #: (N,) the frame.
    frame_idx: IntArray = column(np.int64, refers="frames")
    #: (N,) the sensor.
    sensor_idx: IntArray = column(np.int64, refers="sensors")

    def _check(self) -> None:
        check_unique("Images.ids", self.ids)
