# SPDX-License-Identifier: BSD-3-Clause
"""The common form of everything a scene holds: a frozen table of equally long columns.

A table is a frozen dataclass whose fields are made by :func:`column`. A column knows its dtype and the shape of one
row, which table its indices refer to, what its numbers must be, and how they change when the world moves. So
conversion, validation, selection of rows, renumbering, similarity transforms, comparison and storage are written
once, here and in :mod:`groma.scene.scene`. Every column defaults to no rows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields, replace
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.errors import InputError, ShapeError

if TYPE_CHECKING:
    from groma.scene.similarity import Similarity

SomeTable = TypeVar("SomeTable", bound="Table")
#: What measurements may refer to by kind and index: tables of the scene, by the number of their kind.
OBJECTS = ("images", "control_points", "lines", "planes", "points", "directions")
#: How far a stored quaternion may be from length one.
_QUATERNION_TOLERANCE = 1e-6
#: The least standard deviation, and the inverse of the largest: variances and their products are finite (derived).
_LEAST = 1e-100


def column(
    dtype: type,
    *row: int | None,
    fill: float | None = None,
    refers: str | tuple[str, ...] = (),
    kinds: str = "",
    world: str = "",
    length: int | tuple[Any, ...] = 0,
    optional: bool = False,
    measured: bool = False,
    check: Callable[[str, Any], None] | None = None,
) -> Any:
    """Declare a column of arrays.

    Parameters
    ----------
    dtype : type
        Type of its numbers.
    *row : int or None
        Shape of one row; None: any, but the same in all rows.
    fill : float, optional
        The column may be left out: its rows then hold this number.
    refers : str or (str, str)
        The table of the scene that the indices refer to; of pairs of indices the two tables.
    kinds : str
        The indices refer to tables of :data:`OBJECTS`, selected by the column of this name.
    world : str
        What the rows are in the world, for the column to move with it: ``points``, ``directions``, ``lines``,
        ``planes``, ``poses`` or ``covariances`` (of points), methods of :class:`~groma.scene.similarity.Similarity`.
    length : int or tuple of int
        The power of the scene's unit of length in numbers that do not belong to the world, or one for each of a row:
        1 for depths and their standard deviations, -1 for inverse depths.
    optional : bool
        Whether files may lack the column; it then has no rows.
    measured : bool
        Measured in the world by another instrument: not transformed when the scene is moved to fit.
    check : callable, optional
        Takes the name of the column and its numbers, and raises where they are not valid.
    """
    empty = tuple(0 if size is None else size for size in row)
    about = {"dtype": np.dtype(dtype), "row": row, "fill": fill, "optional": optional}
    about |= {"refers": (refers,) if isinstance(refers, str) else refers, "world": world, "length": length}
    about |= {"kinds": kinds, "measured": measured, "check": check}
    return field(default_factory=lambda: np.zeros((0, *empty), dtype), metadata=about)


def text_column() -> Any:
    """Declare a column of strings, kept as a tuple."""
    return field(default=(), metadata={"dtype": None, "row": (), "refers": ()})


@dataclass(frozen=True, eq=False)
class Table:
    """Equally long columns; see the module."""

    #: What one row is called in messages: ``class Marks(Table, noun="mark", optional=True)``.
    noun: ClassVar[str] = "row"
    #: Whether files may lack the whole table; it then has no rows.
    optional: ClassVar[bool] = False

    def __post_init__(self) -> None:
        length, first = -1, ""
        for item in columns_of(type(self)):
            value = convert(f"{type(self).__name__}.{item.name}", getattr(self, item.name), item)
            object.__setattr__(self, item.name, value)
            if not first:
                length, first = len(value), item.name
            elif len(value) == 0 and item.metadata.get("fill") is not None:
                value = np.full((length, *value.shape[1:]), item.metadata["fill"], value.dtype)
                object.__setattr__(self, item.name, value)
            elif len(value) != length:
                raise ShapeError(
                    f"All columns of {type(self).__name__} must be equally long; {first} has {length} rows, "
                    f"{item.name} has {len(value)}. Pass one row per {self.noun} in both."
                )
        for item in columns_of(type(self)) if len(self) else ():
            if (check := item.metadata.get("check")) is not None:
                check(f"{type(self).__name__}.{item.name}", getattr(self, item.name))
        self._check()

    def _check(self) -> None:
        """Checks of this table alone."""

    def __init_subclass__(cls, noun: str = "", optional: bool = False, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        cls.noun, cls.optional = noun or cls.noun, optional or cls.optional
        cls.__repr__ = Table.__repr__  # type: ignore[method-assign] - not the dataclass's, which prints every number

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self):,} rows: {', '.join(item.name for item in fields(self))})"

    def __len__(self) -> int:
        return len(getattr(self, columns_of(type(self))[0].name))

    def replace(self, **columns: Any) -> Self:
        """Return a copy with some columns replaced."""
        return replace(self, **columns)

    def take(self, rows: npt.ArrayLike) -> Self:
        """Return the chosen rows: integer indices or a boolean mask."""
        chosen = rows_of(f"rows of {type(self).__name__}", rows, len(self), f"{self.noun}s")
        columns = {}
        for item in columns_of(type(self)):
            value = getattr(self, item.name)
            columns[item.name] = tuple(value[i] for i in chosen) if isinstance(value, tuple) else value[chosen]
        return type(self)(**columns)

    def renumbered(self, new_index: Mapping[str, IntArray]) -> tuple[Self, IntArray | None]:
        """Return the table after rows of tables that it refers to moved or went, and which of its own rows are left.

        Parameters
        ----------
        new_index : mapping
            By name of the table in the scene: the new row of each old one, -1 for rows that went. Columns that refer to
            other tables stay as they are.

        Returns
        -------
        table, rows
            The table itself and None if it does not depend on any of them.
        """
        columns = {
            item.name: new_index[item.metadata["refers"][0]][getattr(self, item.name)]
            for item in fields(self)
            if item.metadata["refers"] and item.metadata["refers"][0] in new_index
        }
        columns |= self._objects_renumbered(new_index)
        if not columns:
            return self, None
        kept = np.flatnonzero(np.all([column >= 0 for column in columns.values()], axis=0))
        return self.take(kept).replace(**{name: column[kept] for name, column in columns.items()}), kept

    def _objects_renumbered(self, new_index: Mapping[str, IntArray]) -> dict[str, IntArray]:
        """Return the columns that refer to objects by kind, where a table of theirs was renumbered."""
        columns: dict[str, IntArray] = {}
        for item in fields(self):
            if kinds := item.metadata.get("kinds"):
                before, kind = getattr(self, item.name), getattr(self, kinds)
                after = before.copy()
                for number in np.flatnonzero([name in new_index for name in OBJECTS]):
                    after[kind == number] = new_index[OBJECTS[number]][before[kind == number]]
                if len(before):
                    columns[item.name] = after
        return columns


@cache
def columns_of(table: type[Table]) -> tuple[Field[Any], ...]:
    """Return the declarations of the columns of a table."""
    return fields(table)


def convert(name: str, value: Any, item: Field[Any]) -> Any:
    """Return a column as its declaration wants it, or raise."""
    dtype, row = item.metadata["dtype"], item.metadata["row"]
    if dtype is None:
        return _convert_text(name, value)
    if type(value) is np.ndarray and value.dtype == dtype and value.shape == (0, *row):
        return value
    try:
        source = np.asarray(value)
    except ValueError as error:
        raise ShapeError(f"{name} must be a regular array; got {error}.") from error
    if source.size == 0 and source.ndim <= 1:
        source = np.zeros((0, *(size or 0 for size in row)), dtype)
    if source.dtype.kind not in ("biuf" if dtype.kind == "f" else "biu"):
        wanted = "numbers" if dtype.kind == "f" else "integers"
        raise InputError(f"{name} must hold {wanted}; got dtype {source.dtype}. Convert the array first.")
    if source.ndim != 1 + len(row) or any(
        size is not None and got != size for size, got in zip(row, source.shape[1:], strict=True)
    ):
        wanted = ", ".join(["N", *("K" if size is None else str(size) for size in row)])
        raise ShapeError(f"{name} must have shape ({wanted}{',' if not row else ''}); got {source.shape}.")
    array = np.ascontiguousarray(source, dtype)
    if dtype.kind == "f":
        # The sum of a good array is nearly always finite and needs no temporary; else check each number.
        with np.errstate(over="ignore", invalid="ignore"):
            suspicious = not np.isfinite(array.sum())
        if suspicious and not np.isfinite(array).all():
            first = int(np.argwhere(~np.isfinite(array))[0, 0])
            raise InputError(
                f"{name} must be finite; row {first} is {array[first].tolist()}. Remove or repair that row."
            )
    elif array.dtype != source.dtype and not np.array_equal(array, source):
        raise InputError(f"{name} holds integers that do not fit {array.dtype}. Renumber them.")
    return array


def _convert_text(name: str, value: Any) -> tuple[str, ...]:
    if isinstance(value, str) or not isinstance(value, (Sequence, np.ndarray)):
        raise InputError(f"{name} must be a sequence of strings; got {type(value).__name__}.")
    names = tuple(str(entry) for entry in value)
    for index, entry in enumerate(names):
        if any(character in entry for character in "\0\n\r"):
            raise InputError(f"{name}[{index}] must not hold line breaks or NUL; got {entry!r}. Rename it.")
    return names


def rows_of(name: str, chosen: npt.ArrayLike, size: int, target: str) -> IntArray:
    """Return rows of a table of ``size`` rows that were chosen by integers or by a boolean mask, as integers.

    Raises
    ------
    ShapeError
        If a mask is not as long as the table, or the choice has more than one axis.
    InputError
        If the choice is neither, or points outside.
    """
    rows = np.asarray(chosen)
    if rows.dtype == bool:
        if rows.shape != (size,):
            raise ShapeError(
                f"{name}: a mask must have shape ({size},), one entry for each of {target}; got {rows.shape}."
            )
        return np.flatnonzero(rows)
    if rows.size == 0:
        return np.zeros(0, np.int64)
    if rows.ndim > 1:
        raise ShapeError(f"{name} must have shape (n,); got {rows.shape}.")
    if rows.dtype.kind not in "iu":
        raise InputError(
            f"{name} must be integers or a mask; got {rows.dtype} such as {rows.flat[0]!r}. Pass positions."
        )
    rows = rows.astype(np.int64, copy=False).reshape(-1)
    check_index(name, rows, size, target)
    return rows


@cache
def references(scene: type) -> tuple[tuple[str, str, int | None, str], ...]:
    """Return (table, column, side of a pair or None, table it refers to) of all columns of indices of a scene."""
    return tuple(
        (table.name, item.name, side if len(item.metadata["refers"]) > 1 else None, target)
        for table in fields(scene)
        for item in fields(table.default_factory)  # type: ignore[arg-type]  # the factories are the classes
        for side, target in enumerate(item.metadata["refers"])
    )


@cache
def object_references(scene: type) -> tuple[tuple[str, str, str], ...]:
    """Return (table, column, column of kinds) of all columns of a scene that refer to :data:`OBJECTS`."""
    return tuple(
        (table.name, item.name, kinds)
        for table in fields(scene)
        for item in fields(table.default_factory)  # type: ignore[arg-type]  # the factories are the classes
        if (kinds := item.metadata.get("kinds"))
    )


def moved_table(table: Any, new_from_old: Similarity, measured: bool = True) -> Any:
    """Return a transformed table; without ``measured``, measurements of other instruments are kept."""
    columns = {}
    for item in fields(table):
        about, values = item.metadata, getattr(table, item.name)
        if (about.get("world") or about.get("length")) and len(values) and (measured or not about.get("measured")):
            columns[item.name] = _moved_column(values, about, new_from_old)
    return replace(table, **columns) if columns else table


def _moved_column(values: FloatArray, about: Mapping[str, Any], new_from_old: Similarity) -> FloatArray:
    """Return a column transformed, or in another unit of length, by its declaration."""
    if about["world"]:
        return getattr(new_from_old, about["world"])(values)
    return values * new_from_old.scale ** np.asarray(about["length"], float)


def new_index_of(kept: IntArray, size: int) -> IntArray:
    """Return the new row of each of ``size`` old ones, -1 for those that are not kept."""
    index = np.full(size, -1, np.int64)
    index[kept] = np.arange(len(kept))
    return index


def check_sigma(name: str, sigma: FloatArray) -> None:
    """Raise when a standard deviation, or another number, is not positive, or its square may overflow."""
    if not len(sigma) or (sigma.min() >= _LEAST and sigma.max() <= 1.0 / _LEAST):
        return
    row = int(np.argwhere((sigma < _LEAST) | (sigma > 1.0 / _LEAST))[0, 0])
    limits = f"between {_LEAST} and {1.0 / _LEAST}" if np.min(sigma[row]) > 0.0 else "positive"
    raise InputError(f"{name} must be {limits}; row {row} is {sigma[row]}. Leave out what is not known at all.")


def check_unique(name: str, ids: IntArray) -> None:
    """Raise when an identifier occurs twice."""
    if len(ids) < 2:
        return
    ordered = np.sort(ids)
    same = np.flatnonzero(ordered[1:] == ordered[:-1])
    if len(same):
        raise InputError(f"{name} must be unique; {ordered[same[0]]} occurs more than once. Renumber them.")


def check_index(name: str, index: IntArray, size: int, target: str) -> None:
    """Raise when an index points outside ``0 .. size - 1``."""
    if len(index) == 0 or (index.min() >= 0 and index.max() < size):
        return
    row = int(np.flatnonzero((index < 0) | (index >= size))[0])
    there = f"{target}: 0-{size - 1}" if size else f"there are no {target}"
    raise InputError(
        f"{name}[{row}] is {index[row]}, which is not in the scene ({there}). Drop that row or add what it refers to."
    )


def check_quaternions(name: str, poses: FloatArray) -> None:
    """Raise unless poses (N, 7) start with unit quaternions."""
    if len(poses) == 0:
        return
    with np.errstate(over="ignore"):
        deviation = np.abs(np.einsum("ij,ij->i", poses[:, :4], poses[:, :4]) - 1)
    if deviation.max() > 2 * _QUATERNION_TOLERANCE:
        row = int(deviation.argmax())
        raise InputError(
            f"{name} must begin with a unit quaternion [qx qy qz qw]; row {row} has {poses[row, :4].tolist()}. "
            "Divide it by its length."
        )


def joined(table: SomeTable, other: SomeTable) -> SomeTable:
    """Return the rows of two tables, one after the other."""
    columns = {}
    for item in fields(table):
        first, second = getattr(table, item.name), getattr(other, item.name)
        if isinstance(first, tuple):
            columns[item.name] = (*first, *second)
            continue
        width = max(first.shape[1:], second.shape[1:])
        parts = [np.zeros((len(part), *width), part.dtype) for part in (first, second)]
        for part, values in zip(parts, (first, second), strict=True):
            part[(slice(None), *(slice(0, size) for size in values.shape[1:]))] = values
        columns[item.name] = np.concatenate(parts)
    return type(table)(**columns)
