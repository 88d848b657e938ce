# SPDX-License-Identifier: BSD-3-Clause
"""What Numba's compiler asks again and again, answered sooner; the answers are Numba's.

Numba looks for the meaning of ``a + b`` among some fifteen rules, in every function and several times in each. Here it
is remembered by the types of the operands, as are numbers of arrays, attributes such as ``shape``, and functions of
Python such as ``max``: a tenth of the time that Python takes of a compilation.

In come steps and classes of Numba's compiler; out comes ``TypeInference``, one of the steps.
"""

from __future__ import annotations

import builtins
import math
import operator
from typing import Any

from numba.core import types
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NopythonTypeInference

_KNOWN = frozenset(
    value
    for module in (operator, builtins, math)
    for value in vars(module).values()
    if callable(value) and not isinstance(value, type)
)
#: Meaning of operators for types of operands, and the like, with what it was found in.
_meanings: dict[Any, tuple[Any, Any]] = {}


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
