# SPDX-License-Identifier: BSD-3-Clause
"""Small helpers that factor files share: writing blocks into records, poses as kernels read them."""

from __future__ import annotations

import numpy as np

from groma._numba import kernel
from groma._typing import FloatArray
from groma.geometry import se3

#: Squared angle below which coefficients come from their series, as the closed forms lose up to theta^-5 eps to
#: cancellation (derived from the precision of doubles).
SMALL_TURN = 0.01


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def put_block(J, record, column):
    """Copy the Jacobian block ``J`` (m, k) into one record (m, width) at ``column``; -1 means it is not wanted."""
    if column >= 0:
        for i in range(J.shape[0]):
            for j in range(J.shape[1]):
                record[i, column + j] = J[i, j]


@kernel
def put_residual(r, record):
    """Copy the residual ``r`` (m,) into the last column of one record (m, width)."""
    last = record.shape[1] - 1
    for i in range(r.shape[0]):
        record[i, last] = r[i]


# ------------------------------------------------------------------------------------------------------------- Public
def poses_from_states(poses: FloatArray) -> FloatArray:
    """Return poses (N, 7) as the twelve numbers [R | t] that kernels read, (N, 12)."""
    return np.ascontiguousarray(se3.to_matrix(poses)[:, :3, :]).reshape(len(poses), 12)
