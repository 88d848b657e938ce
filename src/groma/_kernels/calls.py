# SPDX-License-Identifier: BSD-3-Clause
"""What Python calls: code that takes arguments apart for a compiled function, half as long as Numba's.

Numba counts a reference of each array, looks for an error after each argument, and gives up what it has counted on a
path of its own for each. Here arrays are borrowed, since the caller holds them, and one look after the last argument is
enough: nothing is to be given up. A tuple of ``None`` is not read at all. Such functions take arrays, numbers with a
sign, and tuples of them, and return no arrays; all others are called by Numba's code.

In come a function's types; out comes LLVM's code.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir as llvm
from numba.core import cgutils, types
from numba.core.callwrapper import PyCallWrapper

_NUMBERS = {*types.signed_domain, types.float32, types.float64}


def is_readable(kind: Any) -> bool:
    """Whether arguments of a type are read here: arrays, signed and real numbers, nothing, and tuples of such."""
    if isinstance(kind, types.Tuple | types.UniTuple):
        return all(map(is_readable, kind.types))
    return type(kind) in (types.Array, types.Boolean, types.NoneType) or kind in _NUMBERS


class CallWrapper(PyCallWrapper):
    """Code that Python calls, with borrowed arguments."""

    def build_wrapper(self, api: Any, builder: Any, closure: Any, args: Any, kws: Any) -> None:
        """Take the arguments apart, call the function, and return what it returns."""
        #: Not zero where an argument is no array.
        self._failed = llvm.Constant(llvm.IntType(32), 0)
        kinds = self.fndesc.argtypes
        values = [self._read(api, api.tuple_getitem(args, place), kind) for place, kind in enumerate(kinds)]
        with builder.if_then(cgutils.is_not_null(builder, self._failed), likely=False):
            api.err_set_string("PyExc_TypeError", "an argument is not the array that it was")
        with builder.if_then(cgutils.is_not_null(builder, api.err_occurred()), likely=False):
            builder.ret(api.get_null_object())
        thread = api.save_thread() if self.release_gil else None
        status, value = self.context.call_conv.call_function(
            builder, self.func, self.fndesc.restype, kinds, values, attrs=("noinline",)
        )
        if thread is not None:
            api.restore_thread(thread)
        with builder.if_then(status.is_ok, likely=True):
            with builder.if_then(status.is_none):
                api.return_none()
            builder.ret(api.from_native_return(self._simplified_return_type(), value, None))
        self.context.call_conv.raise_error(builder, api, status)
        builder.ret(api.get_null_object())

    def _read(self, api: Any, item: Any, kind: Any) -> Any:
        """Return the value of an argument, or of one in a tuple."""
        builder, context = api.builder, self.context
        if isinstance(kind, types.Array):
            array = context.make_array(kind)(context, builder)._getpointer()
            code = api.numba_array_adaptor(item, builder.bitcast(array, api.voidptr))
            self._failed = builder.or_(self._failed, code)
            return builder.load(array)
        if isinstance(kind, types.Tuple | types.UniTuple):
            if all(part is types.none for part in kind.types):
                return cgutils.get_null_value(context.get_value_type(kind))
            parts = [self._read(api, api.tuple_getitem(item, k), part) for k, part in enumerate(kind.types)]
            return context.make_tuple(builder, kind, parts)
        if isinstance(kind, types.Boolean):
            found = api.object_istrue(item)
            return builder.icmp_signed("!=", found, llvm.Constant(found.type, 0))
        if isinstance(kind, types.Integer):
            return builder.trunc(api.long_as_longlong(item), context.get_argument_type(kind))
        if kind is types.none:
            return context.get_dummy_value()
        found = api.float_as_double(item)
        return found if kind == types.float64 else builder.fptrunc(found, context.get_argument_type(kind))
