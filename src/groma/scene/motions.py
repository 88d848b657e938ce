# SPDX-License-Identifier: BSD-3-Clause
"""How cameras with a rolling shutter moved while their images were read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.errors import InputError
from groma.scene.table import Table, check_sigma, check_unique, column

#: What an image is read by: rows of pixels, from the top; or columns, from the left.
ROWS, COLUMNS = 0, 1


@dataclass(frozen=True, eq=False)
class CameraMotions(Table, noun="motion", optional=True):
    """Rolling-shutter images and the motion of the camera during readout: uniform, along its own axes.

    The pose of such an image is that of its middle row. Where the last row is read first, all numbers have the other
    sign; nothing else depends on the direction.
    """

    #: (N,) the image, each once; those that are not named were taken at once.
    image_idx: IntArray = column(np.int64, refers="images", check=check_unique)
    #: (N, 6) how far the camera moves while the whole image is read (scene units) and turns (rotation vector, radians),
    #: both in the axes that it has in the middle: estimated.
    motion: FloatArray = column(np.float64, 6, length=(1, 1, 1, 0, 0, 0))
    #: (N, 6) the prior motion, and its standard deviations.
    expected: FloatArray = column(np.float64, 6, length=(1, 1, 1, 0, 0, 0))
    sigma: FloatArray = column(np.float64, 6, length=(1, 1, 1, 0, 0, 0), check=check_sigma)
    #: (N,) :data:`ROWS` or :data:`COLUMNS`.
    axis: IntArray = column(np.int64, fill=ROWS)

    def _check(self) -> None:
        if len(self) and not np.isin(self.axis, (ROWS, COLUMNS)).all():
            raise InputError(f"CameraMotions.axis must be 0 or 1; got {sorted(set(self.axis.tolist()))}.")
