# SPDX-License-Identifier: BSD-3-Clause
r"""A factor of your own: one function, at compiled speed.

::

    import groma

    @groma.factor("range", slots=[("pose", "pose"), ("point", "point")], residual_size=1, data_size=1)
    def Range(data, pose, point, out):
        x, y, z = transform(pose, point)          # from groma.factors.user import transform
        out[0] = (x * x + y * y + z * z) ** 0.5 - data[0]

    ranges = Range(pose=Ref("poses", i), point=Ref("points", j), data=measured[:, None])

The function computes one residual. It gets the row of ``data`` of its factor, then what the variable of each slot
looks like, and writes ``out``:

=============  =====================================================================
kind           argument
=============  =====================================================================
pose           (3, 4) matrix [R | t] of ``cam_from_world``
point          (3,)
line           (6,) Plücker (m, d) of any scale: the residual must not depend on it
plane          (4,) (n, w) of any scale: likewise
direction      (3,) unit vector
intrinsics     (k,)
vector         (k,)
=============  =====================================================================

It must be of the kind that Numba compiles (numbers and small arrays; no objects, no text). A factor that cannot be
evaluated writes NaN: it is then counted as degenerate and left out. Writing to the arguments has no effect.

Derivatives are taken for you, with respect to the factor coordinates (see :mod:`groma.geometry.manifold`; a pose
moves by the left twist, :math:`T \leftarrow (I + h\,\hat\xi)\,T`):

``central``
    :math:`(r(x + h) - r(x - h)) / 2h` with :math:`h = \epsilon^{1/3} \max(1, |x|)`; about ten digits.
``complex``
    :math:`\mathrm{Im}\, r(x + ih) / h` with :math:`h = 10^{-30}`; all digits, half the evaluations, though of complex
    numbers (``np.sqrt`` is then much faster than ``** 0.5``). The function must be analytic: no ``abs``, no ``max``, no
    comparison of variables, no conjugate; a norm is the root of a sum of squares.

or they come from a function of yours, ``jacobian(data, *variables, *blocks)``, with one block (m, columns) per slot.

The loop around the function is written for its number of slots and compiled together with it when the first factor is
evaluated (a second or two). It is kept on disk like the functions of groma, and compiled again when the function, or
something that it uses, has changed. A function that was typed in has no file to belong to, and is compiled each time.
"""

from __future__ import annotations

import dataclasses
import inspect
import keyword
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from groma._numba import kernel
from groma._typing import Columns, FloatArray, Inputs
from groma.errors import InputError, ShapeError
from groma.factors._examples import indices, make_example
from groma.factors._measured import set_rows
from groma.factors._user_loops import Loops
from groma.factors.contract import Example, Factor, Invariance, Ref, Slot, register
from groma.geometry.manifold import AMBIENT_SIZE, Euclidean

#: Kinds whose size is not fixed; their slot is (name, kind, size).
FREE_KINDS = ("intrinsics", "vector")
#: Kinds of variables that a function may take.
KINDS = (*(kind for kind in AMBIENT_SIZE if kind != "similarity"), *FREE_KINDS)


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def transform(pose, point):
    """Return the coordinates (x, y, z) in the camera of a world point (3,), given the pose (3, 4)."""
    return (
        pose[0, 0] * point[0] + pose[0, 1] * point[1] + pose[0, 2] * point[2] + pose[0, 3],
        pose[1, 0] * point[0] + pose[1, 1] * point[1] + pose[1, 2] * point[2] + pose[1, 3],
        pose[2, 0] * point[0] + pose[2, 1] * point[1] + pose[2, 2] * point[2] + pose[2, 3],
    )


# ------------------------------------------------------------------------------------------------------------- Public
@dataclasses.dataclass(frozen=True, kw_only=True)
class UserFactor(Factor):
    """Base of the factor types that :func:`factor` makes."""

    #: (N, data_size) measurements, one row per factor; None where the type needs none.
    data: FloatArray | None = None

    #: Numbers per row of `data`.
    data_size: ClassVar[int] = 0
    #: Not declared unless :func:`factor` is told.
    invariance: ClassVar[Invariance | None] = None
    #: The user's function, before compilation.
    function: ClassVar[Callable]

    _loops: ClassVar[Loops]
    _make_example: ClassVar[Callable[[type[Factor], np.random.Generator], Example] | None] = None

    def __post_init__(self) -> None:
        if self.data is None and self.data_size == 0:
            object.__setattr__(self, "data", np.zeros((len(self), 0)))
        set_rows(self, "data", self.data_size)

    def prepare(self, ambients: tuple[FloatArray, ...]) -> tuple[Any, ...]:  # noqa: D102
        for slot, ambient, size in zip(self.slots, ambients, self._loops.sizes, strict=True):
            if ambient.shape[1] != size:
                raise ShapeError(
                    f"Slot {slot.name!r} of factor {self.type_name!r} takes variables of {size} numbers; "
                    f"got {ambient.shape[1]}. Give the size in its declaration: ({slot.name!r}, {slot.kind!r}, size)."
                )
        return tuple(np.ascontiguousarray(ambient) for ambient in ambients)

    def _inputs(self, inputs: tuple[Any, ...]) -> list[Any]:
        pairs = zip(inputs, self.references(), strict=True)
        return [self.data, *(value for ambient, (_, ref) in pairs for value in (ambient, ref.index))]

    def residuals(self, inputs: tuple[Any, ...], begin: int, end: int, out: FloatArray) -> int:  # noqa: D102
        with np.errstate(all="ignore"):  # matters with NUMBA_DISABLE_JIT=1 only
            return self._loops.get()[0](*self._inputs(inputs), begin, end, out)

    def linearize(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        with np.errstate(all="ignore"):
            return self._loops.get()[1](*self._inputs(inputs), begin, end, columns, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        if cls._make_example is not None:
            return cls._make_example(cls, rng)
        refs: dict[str, Any] = {slot.name: Ref(slot.name, indices(rng, 4)) for slot in cls.slots}
        sizes = zip(cls.slots, cls._loops.sizes, strict=True)
        manifolds = {slot.name: Euclidean(size, slot.kind) for slot, size in sizes if slot.kind in FREE_KINDS}
        return make_example(cls(**refs, data=rng.normal(size=(6, cls.data_size))), rng, manifolds=manifolds)


def _read_slots(name: str, slots: Sequence[tuple]) -> tuple[tuple[Slot, ...], tuple[int, ...]]:
    """Return the slots and the numbers that each hands to the function."""
    read, sizes = [], []
    reserved = {field.name for field in dataclasses.fields(UserFactor)} | set(dir(UserFactor))
    for slot in slots:
        if not 2 <= len(slot) <= 3 or slot[1] not in KINDS:
            raise InputError(
                f"A slot of factor {name!r} must be (name, kind), or (name, kind, size) for the kinds "
                f"{', '.join(FREE_KINDS)}; got {slot!r}. Kinds: {', '.join(KINDS)}."
            )
        if (len(slot) == 3) != (slot[1] in FREE_KINDS):
            raise InputError(
                f"Slot {slot[0]!r} of factor {name!r}: the kind {slot[1]!r} "
                f"{'needs a size' if len(slot) == 2 else 'has a fixed size'}; got {slot!r}."
            )
        if not slot[0].isidentifier() or keyword.iskeyword(slot[0]) or slot[0] in reserved:
            raise InputError(f"{slot[0]!r} cannot be the name of a slot of factor {name!r}. Take another word.")
        read.append(Slot(slot[0], slot[1]))
        sizes.append(int(slot[2]) if len(slot) == 3 else AMBIENT_SIZE[slot[1]])
    if not read or len({slot.name for slot in read}) != len(read):
        raise InputError(f"Factor {name!r} needs at least one slot, each with a name of its own; got {list(slots)!r}.")
    return tuple(read), tuple(sizes)


def _check_arguments(name: str, role: str, function: Callable, count: int, wanted: str) -> None:
    """Check that ``function`` takes ``count`` arguments."""
    try:
        inspect.signature(getattr(function, "py_func", function)).bind(*range(count))
    except TypeError as error:
        raise InputError(f"The {role} function of factor {name!r} must take ({wanted}): {error}.") from error


def factor(
    name: str,
    *,
    slots: Sequence[tuple[str, str] | tuple[str, str, int]],
    residual_size: int,
    data_size: int = 0,
    derivative: str = "central",
    jacobian: Callable | None = None,
    example: Callable[[type[Factor], np.random.Generator], Example] | None = None,
    invariance: Invariance | None = None,
) -> Callable[[Callable], type[UserFactor]]:
    """Turn a function into a registered factor type; used as a decorator (see the top of this module).

    Parameters
    ----------
    name : str
        Name to register the type under.
    slots : sequence of (name, kind) or (name, kind, size)
        The variables, in the order of the function's arguments; a size only for intrinsics and vectors.
    residual_size : int
        Rows m of one residual.
    data_size : int
        Measured numbers of one factor.
    derivative : str
        ``central`` differences or ``complex`` step; without effect if `jacobian` is given.
    jacobian : callable, optional
        ``jacobian(data, *variables, *blocks)``, filling the blocks (m, columns), which come as zeros:
        six columns for a pose (the left twist, translation first), as many as numbers for other kinds.
    example : callable, optional
        ``example(cls, rng)`` returning an :class:`~groma.factors.Example`, where random variables and data will not do.
    invariance : Invariance, optional
        Which motions of the world the residual does not notice; :func:`groma.testing.check_factor` then checks it.

    Returns
    -------
    callable
        Decorator from the function to a subclass of :class:`UserFactor`, a frozen dataclass with one
        :class:`~groma.factors.Ref` per slot, `data`, `sqrt_information` and `loss`.

    Raises
    ------
    InputError
        If the declaration is not consistent, or the function takes other arguments. If Numba cannot compile the
        function, the error comes when a factor is first evaluated.
    """
    read_slots, sizes = _read_slots(name, slots)
    if derivative not in ("central", "complex"):
        raise InputError(f"`derivative` of factor {name!r} must be 'central' or 'complex'; got {derivative!r}.")
    if residual_size < 1 or data_size < 0:
        raise InputError(
            f"Factor {name!r} needs residual_size >= 1 and data_size >= 0; got {residual_size} and {data_size}."
        )
    variables = ", ".join(slot.name for slot in read_slots)
    if jacobian is not None:
        blocks = ", ".join(f"J_{slot.name}" for slot in read_slots)
        _check_arguments(name, "jacobian", jacobian, 1 + 2 * len(sizes), f"data, {variables}, {blocks}")

    def decorate(function: Callable) -> type[UserFactor]:
        _check_arguments(name, "residual", function, 2 + len(sizes), f"data, {variables}, out")
        kind_of_derivative = derivative if jacobian is None else "given"
        body: Mapping[str, Any] = {
            "__doc__": function.__doc__ or f"User factor {name!r}.",
            "__module__": function.__module__,
            "slots": read_slots,
            "rows": residual_size,
            "data_size": data_size,
            "invariance": invariance,
            "function": staticmethod(function),
            "_loops": Loops(name, function, jacobian, kind_of_derivative, read_slots, sizes, residual_size),
            "_make_example": staticmethod(example) if example is not None else None,
        }
        cls = dataclasses.make_dataclass(
            function.__name__,
            [(slot.name, Ref) for slot in read_slots],
            bases=(UserFactor,),
            namespace=dict(body),
            frozen=True,
            kw_only=True,
        )
        cls.__qualname__ = function.__qualname__
        return register(name)(cls)

    return decorate
