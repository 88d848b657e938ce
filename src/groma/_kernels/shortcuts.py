# SPDX-License-Identifier: BSD-3-Clause
"""What Numba's compiler asks again and again, answered sooner; the answers are Numba's.

Numba looks for the meaning of ``a + b`` among some fifteen rules, in every function and several times in each. Here it
is remembered by the types of the operands: a tenth of the time that Python takes of a compilation.

In come steps and classes of Numba's compiler; out comes ``TypeInference``, one of the steps.
"""

from __future__ import annotations

import operator
from typing import Any

from numba.core import types
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NopythonTypeInference

_OPERATORS = frozenset(value for value in vars(operator).values() if callable(value))
#: Meaning of operators for types of operands, with what it was found in.
_meanings: dict[tuple[int, tuple[Any, ...]], tuple[Any, Any]] = {}


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
        if rules is None and func in _OPERATORS:
            rules = self._context._lookup_global(func)
        if kws or rules is None or rules.typing_key not in _OPERATORS or not all(map(_is_simple, args)):
            return self._context.resolve_function_type(func, args, kws)
        key = id(rules), tuple(args)
        if key not in _meanings:
            _meanings[key] = rules, self._context.resolve_function_type(func, args, kws)
        return _meanings[key][1]


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
