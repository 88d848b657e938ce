# SPDX-License-Identifier: BSD-3-Clause
"""Frames (a rig at one moment) and the images taken by them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.scene.table import Table, check_unique, column, text_column


@dataclass(frozen=True, eq=False)
class Frames(Table, noun="frame"):
    """Where each rig was: one row per moment."""

    #: (F,) identifiers.
    ids: IntArray = column(np.int64, check=check_unique)
    #: (F,) the rig.
    rig_idx: IntArray = column(np.int64, refers="rigs")
    #: (F, 7) pose [qx qy qz qw tx ty tz], unit quaternions, scene units.
    rig_from_world: FloatArray = column(np.float64, 7, world="poses")


@dataclass(frozen=True, eq=False)
class Images(Table, noun="image"):
    """Images: a frame seen by one of its sensors."""

    #: (N,) identifiers.
    ids: IntArray = column(np.int64, check=check_unique)
    #: (N,) file names.
    names: tuple[str, ...] = text_column()
    #: (N,) the camera (calibration).
    camera_idx: IntArray = column(np.int64, refers="cameras")
    #: (N,) the frame.
    frame_idx: IntArray = column(np.int64, refers="frames")
    #: (N,) the sensor.
    sensor_idx: IntArray = column(np.int64, refers="sensors")
