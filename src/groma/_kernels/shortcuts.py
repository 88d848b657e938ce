# SPDX-License-Identifier: BSD-3-Clause
"""What Numba's compiler asks again and again, answered sooner; the answers are Numba's.

Numba looks for the meaning of ``a + b`` among some fifteen rules, in every function and several times in each. Here it
is remembered by the types of the operands, as are numbers of arrays, attributes such as ``shape``, and functions of
Python such as ``max``: a tenth of the time that Python takes of a compilation. Numba asks again when it makes code,
and tells whoever listens of every call of LLVM, though nobody does: another tenth. To count a reference to an array it
takes the whole description apart: a fifth of the instructions for LLVM, without effect. Where it has no code for
something it goes through all registries of code anew, some seven times in each function. It prepares for an error in
every statement, and reads the arguments of each rule anew. It finds the type of every variable three times where once
is enough, and goes through the whole function for each variable that it renames: another tenth.

One answer is not Numba's: whether a number is finite. Numba tests ``x - x``, which is zero, and not NaN, for whatever
sum ``x`` is, as soon as operations may be regrouped.

In come steps and classes of Numba's compiler; out come ``TypeInference``, one of the steps, and ``remembering``, inside
which code is made.
"""

from __future__ import annotations

import builtins
import math
import operator
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir
from numba.core import base, event, lowering, ssa, typeinfer, types
from numba.core import ir as numba_ir
from numba.core.base import BaseContext
from numba.core.compiler_machinery import register_pass
from numba.core.errors import ForceLiteralArg, NumbaWarning, TypingError, new_error_context  # type: ignore[attr-defined]
from numba.core.runtime.context import NRTContext
from numba.core.targetconfig import TargetConfig
from numba.core.typed_passes import NopythonTypeInference
from numba.core.typeinfer import CallConstraint, ConstraintNetwork
from numba.core.types.functions import BaseFunction

_KNOWN = frozenset(
    value
    for module in (operator, builtins, math)
    for value in vars(module).values()
    if callable(value) and not isinstance(value, type)
)
#: Meaning of operators for types of operands, and the like, with what it was found in.
_meanings: dict[Any, tuple[Any, Any]] = {}
#: Where constraints say which variable they define.
_DEFINED = ("target", "dst")
#: What Numba calls the events around each call of LLVM.
_LLVM_CALLS = "numba:llvm_lock"
_call_type, _find_counts, _refresh = BaseFunction.get_call_type, NRTContext.get_meminfos, BaseContext.refresh
_TRUTH = ir.IntType(1)
_propagate, _to_single_assignment, _rewrite = ConstraintNetwork.propagate, ssa._run_ssa, ssa._run_block_rewrite
_extract, _has_place = ir.IRBuilder.extract_value, cache(base._has_loc)


def _is_simple(kind: Any) -> bool:
    """Whether a type is that of an array, a number, nothing, or a tuple of such."""
    if isinstance(kind, types.Tuple | types.UniTuple):
        return all(map(_is_simple, kind.types))
    return isinstance(kind, types.Number | types.Array | types.Boolean | types.NoneType)


class _Typing:
    """Numba's rules for types, which remembers what operators mean."""

    def __init__(self, context: Any) -> None:
        self._context = context

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)

    def resolve_function_type(self, func: Any, args: Any, kws: Any) -> Any:
        """Return the signature of a call."""
        rules = func if isinstance(func, types.Function) else None
        if rules is None and func in _KNOWN:
            rules = self._context._lookup_global(func)
        if kws or rules is None or rules.typing_key not in _KNOWN or not all(map(_is_simple, args)):
            return self._context.resolve_function_type(func, args, kws)
        return self._remembered((id(rules), tuple(args)), rules, "resolve_function_type", func, args, kws)

    def resolve_setitem(self, target: Any, index: Any, value: Any) -> Any:
        """Return the signature of ``target[index] = value``."""
        kinds = target, index, value
        if not all(map(_is_simple, kinds)):
            return self._context.resolve_setitem(*kinds)
        return self._remembered((operator.setitem, kinds), None, "resolve_setitem", *kinds)

    def resolve_getattr(self, typ: Any, attr: str) -> Any:
        """Return the type of an attribute."""
        if not isinstance(typ, types.Array | types.Function | types.Dispatcher):
            return self._context.resolve_getattr(typ, attr)
        return self._remembered((typ, attr), None, "resolve_getattr", typ, attr)

    def _remembered(self, key: Any, kept: Any, name: str, *asked: Any) -> Any:
        """Return an answer of Numba's; ``kept`` is what must not go, as long as the key names it by its place."""
        if key in _meanings:
            return _meanings[key][1]
        answer = getattr(self._context, name)(*asked)
        if answer is not None:  # later there may be one
            _meanings[key] = kept, answer
        return answer


@register_pass(mutates_CFG=True, analysis_only=False)
class TypeInference(NopythonTypeInference):
    """The step of Numba's compiler, with that."""

    _name = "groma_type_inference"

    def run_pass(self, state: Any) -> Any:
        """Find the types of all variables."""
        context = state.typingctx
        state.typingctx = _Typing(context)
        try:
            return super().run_pass(state)
        finally:
            state.typingctx = context


def _remembered_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
    """Take the place of :meth:`BaseFunction.get_call_type`."""
    if kws or self.typing_key not in _KNOWN or not all(map(_is_simple, args)):
        return _call_type(self, context, args, kws)
    key = "call", id(self), tuple(args)
    if key not in _meanings:
        _meanings[key] = self, _call_type(self, context, args, kws)
    return _meanings[key][1]


def _names(value: Any) -> Iterator[str]:
    """Yield the variables in a part of a constraint, and other texts."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, numba_ir.Var):
        yield value.name
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _names(item)
    elif isinstance(value, CallConstraint):
        yield from _read(value)


def _read(constraint: Any) -> list[str]:
    """Return the variables that a constraint reads; one that it defines is a text."""
    parts = [part for place, part in vars(constraint).items() if place not in _DEFINED or not isinstance(part, str)]
    return list(_names(parts))


def _is_settled(kind: Any) -> bool:
    """Whether what a constraint makes of a type is the same each time."""
    if kind is None or kind is types._undef_var or isinstance(kind, types.RecursiveCall):
        return False
    return kind.is_precise()


def _propagated(self: Any, inferer: Any) -> list[Any]:
    """Take the place of :meth:`ConstraintNetwork.propagate`: apply only constraints that read a new type.

    Numba applies all of them until no type changes, the last time to find that none does.
    """
    errors: list[Any] = []
    told: list[tuple[Any, warnings.WarningMessage]] = []
    find = inferer.typevars.get
    with warnings.catch_warnings(record=True) as heard:  # once, not for each constraint
        warnings.simplefilter("always", NumbaWarning)
        for constraint in self.constraints:
            parts = vars(constraint)
            if "groma_read" not in parts:
                parts["groma_read"] = _read(constraint)
            before = [found.type for name in parts["groma_read"] if (found := find(name)) is not None]
            if before == parts.get("groma_seen"):
                continue
            try:
                constraint(inferer)
                raised = []
            except (ForceLiteralArg, TypingError):  # again, for Numba to say what is wrong
                one = ConstraintNetwork()
                one.append(constraint)
                raised = _propagate(one, inferer)
            told.extend((constraint.loc, one) for one in heard)
            heard.clear()
            after = [found.type for place in _DEFINED if (found := find(parts.get(place))) is not None]
            parts["groma_seen"] = None if raised or not all(map(_is_settled, before + after)) else before
            errors.extend(raised)
    for place, one in told:
        with inferer.warnings.catch_warnings(place.filename, place.line):
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    return errors


def _in_single_assignment(blocks: Any) -> Any:
    """Take the place of :func:`ssa._run_ssa`: rename a variable in the blocks that name it, not in all."""
    named = {label: {found.name for one in block.body for found in one.list_vars()} for label, block in blocks.items()}

    def rewrite(blocks: Any, states: Any, handler: Any) -> Any:
        concerned = {label: block for label, block in blocks.items() if states["varname"] in named[label]}
        others = {label: block.copy() for label, block in blocks.items()}
        return {**others, **_rewrite(concerned, states, handler)}

    ssa._run_block_rewrite = rewrite
    try:
        return _to_single_assignment(blocks)
    finally:
        ssa._run_block_rewrite = _rewrite


def _counts(self: Any, builder: Any, ty: Any, val: Any) -> list[Any]:
    """Take the place of :meth:`NRTContext.get_meminfos`: where references to arrays are counted.

    Numba takes the whole description of an array apart to find the first field.
    """
    if type(ty) is types.Array:
        return [(ty, builder.extract_value(val, 0))]
    return _find_counts(self, builder, ty, val)


def _num_registered(context: Any) -> int:
    """Return what grows when more code is registered: by a new module, or in one that is here."""
    registries = (*context._registries, *context.typing_context._registries)
    return len(sys.modules) + sum(len(items) for one in registries for items in vars(one).values())


def _refreshed(self: Any) -> None:
    """Take the place of :meth:`BaseContext.refresh`: look for new code if there may be some."""
    if getattr(self, "groma_registered", None) != _num_registered(self):
        _refresh(self)
        self.groma_registered = _num_registered(self)


@cache
def _defaults(kind: Any) -> dict[str, Any]:
    return {name: option.default for name, option in kind.options.items()}


def _options(self: Any) -> dict[str, Any]:
    """Take the place of :meth:`TargetConfig.values`, which is asked whenever options are compared."""
    return {**_defaults(type(self)), **self._values}


def _extracted(self: Any, agg: Any, idx: Any, name: str = "") -> Any:
    """Take the place of :meth:`IRBuilder.extract_value`: what was put into a tuple need not be taken out again.

    Whether a loop goes on is taken out: LLVM would simplify its branches sooner, to loops of another shape.
    """
    path = list(idx) if isinstance(idx, tuple | list) else [idx]
    while path and (seen := _item(agg, path[0])) is not None and seen.type != _TRUTH:
        agg, path = seen, path[1:]
    return _extract(self, agg, path, name) if path else agg


def _item(value: Any, place: int) -> Any:
    """Return what was put at a place of a tuple, if that can be seen; None otherwise."""
    while isinstance(value, ir.instructions.InsertValue):
        if value.indices[0] == place:
            return value.operands[1] if len(value.indices) == 1 else None
        value = value.operands[0]
    return None


class _Context:
    """Takes the place of ``new_error_context``: an error is told where it happened, and nothing is done otherwise."""

    def __init__(self, *said: Any, **parts: Any) -> None:
        self._said, self._parts = said, parts

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if error is not None:
            with new_error_context(*self._said, **self._parts):
                raise error


def _is_finite(builder: Any, val: Any) -> Any:
    """Take the place of Numba's ``is_finite``: whether the absolute value is below infinity."""
    size = builder.call(builder.module.declare_intrinsic("llvm.fabs", [val.type]), [val])
    return builder.fcmp_ordered("<", size, ir.Constant(val.type, float("inf")))


@contextmanager
def remembering() -> Iterator[None]:
    """Let Numba look for the meaning of operators once; for a thread that holds the lock of the compiler."""
    from numba.cpython import mathimpl as of_python  # with much else that loaded code does not need
    from numba.np.math import mathimpl as of_numpy

    lock: Any = llvm.ffi.lib._lock
    places = (
        (BaseFunction, "get_call_type", _remembered_call_type),
        (NRTContext, "get_meminfos", _counts),
        (BaseContext, "refresh", _refreshed),
        (ConstraintNetwork, "propagate", _propagated),
        (ssa, "_run_ssa", _in_single_assignment),
        (TargetConfig, "values", _options),
        (ir.IRBuilder, "extract_value", _extracted),
        (base, "_has_loc", _has_place),
        (lowering, "new_error_context", _Context),
        (typeinfer, "new_error_context", _Context),
        (of_python, "is_finite", _is_finite),
        (of_numpy, "is_finite", _is_finite),
        (lock, "_cblist", lock._cblist if event._registered.get(_LLVM_CALLS) else []),
    )
    before = [getattr(owner, name) for owner, name, _ in places]
    for owner, name, ours in places:
        setattr(owner, name, ours)
    try:
        yield
    finally:
        for (owner, name, _), numbas in zip(places, before, strict=True):
            setattr(owner, name, numbas)
