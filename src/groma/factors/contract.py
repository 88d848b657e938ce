# SPDX-License-Identifier: BSD-3-Clause
r"""The contract of a factor group, and the registry.

A *factor group* holds ``N`` factors of one type: the indices of the variables each one touches, the measurements,
their noise and one robust loss. A concrete factor is a frozen dataclass in a file of its own. It declares its *slots*
(which kinds of variable it touches), and it evaluates a contiguous range of its factors into arrays that the caller
provides.

The result of a linearisation is a *record* per factor: its ``m`` residual rows, each row holding the Jacobian blocks
and, in the last column, the residual,

.. math:: [\,J_1 \mid J_2 \mid \dots \mid r\,] \in R^{m \times (\sum d_b + 1)} .

The caller decides at which column each block starts (``columns``); -1 means the block is not wanted. Jacobians are
taken with respect to the *factor coordinates* of each kind (see :mod:`groma.geometry.manifold`): a pose block has the
six columns :math:`(\rho, \omega)` of the left twist of ``cam_from_world``, a line block six (m, d), a plane block four
(n, w), a direction three, a point three.

A factor that cannot be evaluated (a line through the camera centre, a point in the camera plane) writes zeros into
its whole record and is counted; it never writes NaN.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, TypeVar

import numpy as np

from groma._typing import Columns, FloatArray, Inputs, IntArray
from groma.errors import ProblemError, ShapeError
from groma.factors._measured import check_finite, normalize_rows, set_rows
from groma.factors.losses import Loss, Trivial
from groma.geometry.manifold import Manifold


@dataclass(frozen=True)
class Ref:
    """Which variables a slot of a factor group refers to: a group of variables and an index for each factor."""

    #: Name of the group of variables in the problem, for example ``"poses"``.
    group: str
    #: (N,) integer, position in that group for each factor.
    index: IntArray

    def __post_init__(self) -> None:
        index = np.ascontiguousarray(self.index, dtype=np.int32)
        if index.ndim != 1:
            raise ShapeError(f"Ref({self.group!r}).index must have shape (N,); got {index.shape}.")
        object.__setattr__(self, "index", index)


@dataclass(frozen=True)
class Slot:
    """One variable that a factor type touches."""

    #: Name of the dataclass field that holds the :class:`Ref`, for example ``"pose"``.
    name: str
    #: Kind of variable, see :mod:`groma.geometry.manifold`.
    kind: str
    #: Whether the field may be None (the slot is then absent from :meth:`Factor.references`).
    optional: bool = False
    #: Whether the variable moves when the world moves. A camera's place on its rig does not, though it is a pose.
    in_world: bool = True


@dataclass(frozen=True)
class Measurement:
    """A field of a factor type with an array of numbers for each factor, all finite."""

    #: Name of the dataclass field, for example ``"pixels"``.
    name: str
    #: Shape of the numbers of one factor.
    shape: tuple[int, ...]
    #: The first so many of them are scaled to norm one on construction.
    num_normalized: int = 0


@dataclass(frozen=True)
class Invariance:
    """Motions of all variables together that leave the residuals of a factor as they are.

    Without a camera among the variables, residuals may be vectors in the world: then their lengths count.
    """

    #: Any translation; not where positions in the world are measured.
    translation: bool = True
    #: Any rotation; or rotations about one axis (x, y, z) of the world only, as where gravity is measured; or none.
    rotation: bool | tuple[float, float, float] = True
    #: Any scaling; not where lengths are measured.
    scale: bool = False


#: Of factors that tie the world down: surveyed positions, priors of poses.
WORLD_FIXED = Invariance(translation=False, rotation=False)
#: Of factors that measure angles only, in images or between directions.
ANY_SIMILARITY = Invariance(scale=True)


@dataclass(frozen=True, kw_only=True)
class Factor(ABC):
    """N factors of one type. Every array field, and every :class:`Ref`, has N as its leading axis."""

    #: Inverse noise, applied from the left to residual and Jacobian: a scalar or (N,) 1/sigma, or (N, m, m) square
    #: root information matrices.
    sqrt_information: float | FloatArray = 1.0
    #: Robust loss on the whitened squared norm of each factor's residual.
    loss: Loss = dataclasses.field(default_factory=Trivial)

    #: Registered name, set by :func:`register`.
    type_name: ClassVar[str] = ""
    #: The variables touched, in order.
    slots: ClassVar[tuple[Slot, ...]]
    #: The arrays that are checked on construction.
    measurements: ClassVar[tuple[Measurement, ...]] = ()
    #: Rows m of one residual; where they are not the same for all factors of a type, it overrides ``residual_size``.
    rows: ClassVar[int]
    #: How many of them are independent; 0: all.
    independent_rows: ClassVar[int] = 0
    #: Whether it says that one thing lies on another: a residual that is zero in truth. What is left of it moves, turns
    #: and scales with the world, and so does its derivative, but neither tells where the world is, or how large.
    is_incidence: ClassVar[bool] = False
    #: Which motions of the world it does not notice; None: not declared, and not checked.
    invariance: ClassVar[Invariance | None] = Invariance()

    def __post_init__(self) -> None:
        """Check that all references and measurements have N rows, and that measurements are finite."""
        for slot, ref in self.references():
            if len(ref.index) != len(self):
                raise ShapeError(
                    f"{type(self).__name__}.{slot.name} must have one index per factor, {len(self)} like its "
                    f"{self.references()[0][0].name}; got {len(ref.index)}."
                )
        for measurement in self.measurements:
            set_rows(self, measurement.name, *measurement.shape)
            check_finite(self, measurement.name)
            if measurement.num_normalized:
                normalize_rows(self, measurement.name, measurement.num_normalized)

    @property
    def residual_size(self) -> int:
        """Rows m of one residual."""
        return self.rows

    @property
    def residual_rank(self) -> int:
        """Independent rows of one residual: less than ``residual_size`` where rows depend on each other."""
        return self.independent_rows or self.residual_size

    def references(self) -> tuple[tuple[Slot, Ref], ...]:
        """The slots that are present, each with the variables it refers to, in order."""
        return self._references

    @cached_property
    def _references(self) -> tuple[tuple[Slot, Ref], ...]:
        present = ((slot, getattr(self, slot.name)) for slot in self.slots)
        return tuple((slot, ref) for slot, ref in present if ref is not None)

    def __len__(self) -> int:
        return len(self.references()[0][1].index)

    def take(self, order: IntArray) -> Factor:
        """Return the factors ``order`` (M,) of this group, in that order."""
        changes: dict[str, Any] = {}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Ref):
                changes[field.name] = Ref(value.group, value.index.take(order))
            elif isinstance(value, np.ndarray) and value.ndim > 0:
                changes[field.name] = value.take(order, axis=0)
        return dataclasses.replace(self, **changes)

    def prepare(self, ambients: tuple[FloatArray, ...]) -> tuple[Any, ...]:
        """Turn the ambient arrays of the present slots into what the evaluation reads; called once per evaluation.

        ``ambients[b]`` is (count, ambient_size) for the group of the b-th reference. The default passes them on; a
        factor that derives something per variable rather than per factor (the poses of rig cameras) does it here.
        """
        return ambients

    def residuals(self, inputs: tuple[Any, ...], begin: int, end: int, out: FloatArray) -> int:
        """Write the residuals of factors begin..end to ``out`` (end-begin, m); return how many are degenerate.

        The default writes records without blocks.
        """
        return self.linearize(inputs, begin, end, (-1,) * len(self.references()), out[:, :, None])

    @abstractmethod
    def linearize(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:
        """Write the records of factors begin..end to ``record`` (end-begin, m, width); return how many are degenerate.

        ``columns[b]`` is the first column of the b-th reference, or -1 if it is not wanted. The last column takes the
        residual. Columns that belong to no block are left alone.
        """

    @classmethod
    @abstractmethod
    def example(cls, rng: np.random.Generator) -> Example:
        """Return a small random valid instance, from which the conformance tests follow."""


@dataclass(frozen=True)
class Example:
    """A factor group with variables that fit it."""

    factor: Factor
    #: For each group of variables: its manifold and its states (count, state_size).
    variables: dict[str, tuple[Manifold, FloatArray]]


_REGISTRY: dict[str, type[Factor]] = {}
_F = TypeVar("_F", bound=type[Factor])


def register(name: str) -> Callable[[_F], _F]:
    """Register a factor type under ``name``; the conformance tests and the docs' table then include it.

    Raises
    ------
    ProblemError
        If the name belongs to another class; the same one may be made again, as in a notebook.
    """

    def decorate(cls: _F) -> _F:
        known = _REGISTRY.get(name, cls)
        if (known.__module__, known.__qualname__) != (cls.__module__, cls.__qualname__):
            raise ProblemError(
                f"A factor named {name!r} is registered already ({known.__module__}.{known.__qualname__}). Choose "
                "another name."
            )
        cls.type_name = name
        _REGISTRY[name] = cls
        return cls

    return decorate


def registered() -> dict[str, type[Factor]]:
    """All registered factor types by name, sorted."""
    return dict(sorted(_REGISTRY.items()))
