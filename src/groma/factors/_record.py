# SPDX-License-Identifier: BSD-3-Clause
"""Small helpers that factor files share: writing blocks into records, checking the arrays of a factor group."""

from __future__ import annotations

from typing import Any

import numpy as np

from groma._numba import kernel
from groma._typing import FloatArray
from groma.errors import InputError, ShapeError
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
def as_rows(factor: Any, field: str, *shape: int) -> FloatArray:
    """Return field ``field`` of ``factor`` as a contiguous (N, *shape) array, N being the number of factors.

    Raises
    ------
    ShapeError
        If the field has another shape.
    """
    array = np.ascontiguousarray(getattr(factor, field), dtype=np.float64)
    expected = (len(factor), *shape)
    if array.shape != expected:
        raise ShapeError(
            f"{type(factor).__name__}.{field} must have shape {expected}, one row for each index of its references; "
            f"got {array.shape}."
        )
    return array


def set_rows(factor: Any, field: str, *shape: int) -> None:
    """Replace field ``field`` of a factor under construction by its checked form (see :func:`as_rows`)."""
    object.__setattr__(factor, field, as_rows(factor, field, *shape))


def check_finite(factor: Any, field: str) -> None:
    """Raise InputError unless all numbers of field ``field`` (N, ...) are finite."""
    rows = getattr(factor, field)
    finite = np.isfinite(rows).all(axis=tuple(range(1, rows.ndim)))
    if not finite.all():
        row = int(np.argmin(finite))
        raise InputError(
            f"{type(factor).__name__}.{field} must be finite; row {row} is {rows[row].tolist()} "
            f"({np.count_nonzero(~finite)} such rows). Leave these observations out."
        )


def normalize_rows(factor: Any, field: str, size: int) -> None:
    """Scale the rows of field ``field`` so that their first ``size`` numbers have norm one.

    Rows that have it already, to rounding, keep their bits. Raises InputError for rows of norm zero, or infinite.
    """
    rows = getattr(factor, field)
    norm = np.linalg.norm(rows[:, :size], axis=1)
    for wrong, words in ((~np.isfinite(norm), "be finite; row {} is not"), (norm == 0.0, "not be zero; row {} is")):
        if wrong.any():
            told = words.format(int(np.argmax(wrong)))
            raise InputError(f"{type(factor).__name__}.{field} must {told}. Leave these observations out.")
    norm[np.abs(norm - 1.0) < 1e-15] = 1.0
    object.__setattr__(factor, field, rows / norm[:, None])


def poses_from_states(poses: FloatArray) -> FloatArray:
    """Return poses (N, 7) as the twelve numbers [R | t] that kernels read, (N, 12)."""
    return np.ascontiguousarray(se3.to_matrix(poses)[:, :3, :]).reshape(len(poses), 12)
