# SPDX-License-Identifier: BSD-3-Clause
"""Checks of the arrays of a factor group: one row a factor, finite, of norm one."""

from __future__ import annotations

from typing import Any

import numpy as np

from groma.errors import InputError, ShapeError


def set_rows(factor: Any, field: str, *shape: int) -> None:
    """Make field ``field`` of a factor under construction a contiguous (N, *shape) array, N the number of factors.

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
    object.__setattr__(factor, field, array)


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
