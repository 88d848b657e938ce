# SPDX-License-Identifier: BSD-3-Clause
"""Small vector helpers shared by the line and plane algebra: checks at the door, products over the last axis."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from groma._numba import kernel
from groma._typing import BoolArray, FloatArray
from groma.errors import InputError, ShapeError


def numbers(value: npt.ArrayLike, name: str) -> FloatArray:
    """``value`` as float64, refused with an InputError unless it is an array of real numbers."""
    try:
        array = np.asarray(value)
        if array.dtype.kind != "c":
            return np.asarray(array, dtype=np.float64)
        reason = "it is complex"
    except (TypeError, ValueError) as error:
        reason = str(error)
    raise InputError(f"{name} must be an array of real numbers; got {type(value).__name__} ({reason.rstrip('.')}).")


def vectors(value: npt.ArrayLike, size: int, name: str, what: str = "") -> FloatArray:
    """``value`` as float64, refused with a ShapeError unless its last axis has ``size`` entries, which are ``what``."""
    array = numbers(value, name)
    if array.ndim == 0 or array.shape[-1] != size:
        turned = array.ndim == 2 and array.shape[0] == size and name.isidentifier()
        hint = f" Did you mean {name}.T?" if turned else ""
        wanted = f"(..., {size}), {what}" if what else f"(..., {size})"
        raise ShapeError(f"{name} must have shape {wanted}; got {array.shape}. Pass one row per item.{hint}")
    return array


def as_rows(array: npt.ArrayLike, row: tuple[int, ...], name: str) -> FloatArray:
    """``array`` as contiguous float64 of shape (N, *row), refused with a ShapeError otherwise."""
    rows = np.ascontiguousarray(numbers(array, name))
    if rows.shape[1:] != row:
        hints = {row + rows.shape[1:]: f"{name}.T", row: f"{name}[None]"}
        hint = f" Did you mean {hints[rows.shape]}?" if rows.shape in hints else ""
        raise ShapeError(f"{name} must have shape (N, {', '.join(map(str, row))}); got {rows.shape}.{hint}")
    return rows


def matrices(value: npt.ArrayLike, rows: int, columns: int, name: str) -> FloatArray:
    """``value`` as float64, refused with a ShapeError unless it ends in ``rows`` x ``columns``."""
    array = numbers(value, name)
    if array.shape[-2:] != (rows, columns):
        raise ShapeError(
            f"{name} must have shape (..., {rows}, {columns}); got {array.shape}. Pass one matrix per item."
        )
    return array


def finite_rows(name: str, values: npt.ArrayLike, row: tuple[int, ...]) -> FloatArray:
    """``values`` as finite float64 of shape (N, *row), refused with a ShapeError or an InputError otherwise."""
    array = numbers(values, name)
    if array.shape[1:] != row:
        wanted = ", ".join(map(str, row))
        raise ShapeError(f"{name} must have shape (N, {wanted}); got {array.shape}.")
    if not np.isfinite(array).all():
        raise InputError(f"{name} must be finite. Remove the rows that are not.")
    return array


def not_negative(value: float, name: str) -> float:
    """``value``, refused with an InputError unless it is zero or greater."""
    if not value >= 0.0:
        raise InputError(f"{name} must be zero or greater; got {value}. Pass a tolerance such as 1e-9.")
    return float(value)


def dot(first: FloatArray, second: FloatArray) -> FloatArray:
    """Dot product (...) of vectors (..., k), the leading axes broadcast."""
    return np.asarray(np.einsum("...i,...i->...", first, second))


def cross(first: FloatArray, second: FloatArray) -> FloatArray:
    """Cross product (..., 3) of vectors (..., 3), the leading axes broadcast.

    The numbers are those of ``np.cross``, which takes several times as long for few vectors.
    """
    a, b = np.asarray(first), np.asarray(second)
    result = np.empty(np.broadcast_shapes(a.shape, b.shape), np.result_type(a, b))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(a[..., j], b[..., k], out=result[..., i])
        result[..., i] -= a[..., k] * b[..., j]
    return result


def norm(vector: FloatArray) -> FloatArray:
    """Euclidean length (...) of vectors (..., k)."""
    return np.asarray(np.sqrt(dot(vector, vector)))


def apply(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Matrices (..., n, k) times vectors (..., k), the leading axes broadcast: (..., n)."""
    return np.asarray(np.einsum("...ij,...j->...i", matrix, vector))


def ratio(numerator: FloatArray, denominator: FloatArray, valid: BoolArray, otherwise: float = np.nan) -> FloatArray:
    """``numerator / denominator`` where ``valid``, else ``otherwise``; never a warning."""
    shape = np.broadcast_shapes(np.shape(numerator), np.shape(denominator), np.shape(valid))
    out = np.full(shape, otherwise)
    np.divide(numerator, denominator, out=out, where=np.broadcast_to(valid, shape))
    return out


def unit(vector: FloatArray) -> FloatArray:
    """Vectors (..., k) divided by their lengths, without overflow or underflow; zero where zero or not finite."""
    if vector.ndim == 1:  # thirty times as fast
        length = math.hypot(*vector)
        if 1e-300 < length < math.inf:
            return vector / length
    largest = np.abs(vector).max(axis=-1, keepdims=True, initial=0.0)
    scaled = ratio(vector, largest, (largest > 0.0) & np.isfinite(largest), 0.0)
    return scaled / np.maximum(norm(scaled), 1.0)[..., None]


def stack(*parts: FloatArray) -> FloatArray:
    """Concatenate over the last axis, the leading axes broadcast."""
    leading = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
    return np.concatenate([np.broadcast_to(part, (*leading, part.shape[-1])) for part in parts], axis=-1)


def perpendicular(direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors b1, b2 (..., 3) such that (b1, b2, d/|d|) is a right-handed orthonormal frame.

    b1 lies across the smallest component of d, so no direction is nearly singular. Charts have another rule, which
    kernels can follow: see :mod:`groma.geometry.charts.chart`.
    """
    if direction.ndim == 1:  # the same, thirty times as fast
        x, y, z = unit(direction).tolist()
        smallest = int(np.argmin(np.abs(direction)))
        first = unit(np.array(((0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0))[smallest]))
        a, b, c = first.tolist()
        return first, np.array([y * c - z * b, z * a - x * c, x * b - y * a])
    axis = np.zeros(direction.shape)
    np.put_along_axis(axis, np.argmin(np.abs(direction), axis=-1)[..., None], 1.0, axis=-1)
    first = unit(cross(direction, axis))
    return first, cross(unit(direction), first)


@kernel
def perpendicular_to(x, y, z):
    """The six numbers of :func:`perpendicular` for one unit vector, in compiled loops; zeros for zero."""
    a, b, c = 0.0, z, -y
    if abs(y) < abs(x) and abs(y) <= abs(z):
        a, b, c = -z, 0.0, x
    elif abs(z) < abs(x) and abs(z) < abs(y):
        a, b, c = y, -x, 0.0
    length = max(math.sqrt(a * a + b * b + c * c), 1e-300)
    a, b, c = a / length, b / length, c / length
    return a, b, c, y * c - z * b, z * a - x * c, x * b - y * a


def cofactor(matrix: FloatArray) -> FloatArray:
    r"""Cofactor matrices of matrices (..., 3, 3), :math:`\det(N) N^{-\top}` also where N is singular.

    Its rows are the cross products of the other two rows: ``cofactor(N) @ (a x b) = (N a) x (N b)``.
    """
    first, second, third = matrix[..., 0, :], matrix[..., 1, :], matrix[..., 2, :]
    return np.stack([cross(second, third), cross(third, first), cross(first, second)], axis=-2)
