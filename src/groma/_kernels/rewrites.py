# SPDX-License-Identifier: BSD-3-Clause
"""Steps of Numba's compiler that are left out where there is nothing for them to do.

Numba looks for functions defined in a function, lists that become arrays, and arithmetic on whole arrays, and to do so
finds last uses of variables anew each time: a twentieth of the time of compiling. Kernels hold none of these.

In come two steps of Numba's compiler; out come the same, which first look whether a function needs them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numba.core import ir, types
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NopythonRewrites as NumbaRewrites
from numba.core.untyped_passes import InlineClosureLikes as NumbaInlineClosureLikes
from numba.np.ufunc.dufunc import DUFunc

#: Functions defined inside, and lists.
_DEFINED_INSIDE = ("make_function", "build_list")
#: Functions that take a function: what they are called in Python.
_TAKE_FUNCTIONS = ("reduce", "stencil")


def _assignments(state: Any) -> Iterator[Any]:
    """Yield all assignments of an expression, function or constant."""
    for block in state.func_ir.blocks.values():
        yield from block.find_insts(ir.Assign)


def _is_inlined(value: Any) -> bool:
    """Whether a value is one of those that :class:`NumbaInlineClosureLikes` looks for."""
    if isinstance(value, ir.Expr):
        return value.op in _DEFINED_INSIDE or (value.op == "getattr" and value.attr in _TAKE_FUNCTIONS)
    given = getattr(value, "value", None) if isinstance(value, ir.Global | ir.FreeVar) else None
    return getattr(given, "__name__", type(given).__name__) in _TAKE_FUNCTIONS


@register_pass(mutates_CFG=True, analysis_only=False)
class InlineClosureLikes(NumbaInlineClosureLikes):
    """Numba's step, where there is a function or a list inside."""

    _name = "groma_inline_closure_likes"

    def run_pass(self, state: Any) -> Any:
        """Inline functions that are defined inside."""
        return any(_is_inlined(found.value) for found in _assignments(state)) and super().run_pass(state)


def _is_rewritten(found: Any, kinds: Any) -> bool:
    """Whether an assignment is of a list, a text, or what operators or calls made of whole arrays."""
    value, kind = found.value, kinds[found.target.name]
    if isinstance(kind, types.StringLiteral):  # it may name a field
        return True
    if not isinstance(value, ir.Expr) or (value.op != "build_list" and not isinstance(kind, types.Array)):
        return False
    if value.op == "call":
        return isinstance(getattr(kinds[value.func.name], "typing_key", None), np.ufunc | DUFunc)
    return value.op in ("build_list", "binop", "unary")


@register_pass(mutates_CFG=True, analysis_only=False)
class NopythonRewrites(NumbaRewrites):
    """Numba's step, where there is arithmetic on whole arrays or a list."""

    _name = "groma_nopython_rewrites"

    def run_pass(self, state: Any) -> Any:
        """Turn arithmetic on whole arrays into loops."""
        return any(_is_rewritten(found, state.typemap) for found in _assignments(state)) and super().run_pass(state)
