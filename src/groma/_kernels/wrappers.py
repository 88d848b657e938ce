# SPDX-License-Identifier: BSD-3-Clause
"""What stands between Python and a compiled function: it unpacks the arguments, calls, and returns.

Numba writes out the description of each array three times, for the call, for its end and for errors, and holds it
across the checks of the other arguments: wrappers were five eighths of the machine code of ``groma demo``. Here a
description stays where it is until the call, and one block lets go of all arrays after an error. Counts of references,
checks and messages are Numba's.

In come the lowered function and its types; out goes the wrapper, in the library of the function. Arguments other than
arrays of numbers, numbers, nothing and tuples of these go the way of Numba.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir as llvm
from numba.core import cgutils, types
from numba.core.callwrapper import PyCallWrapper
from numba.core.runtime.nrtdynmod import incref_decref_ty
from numba.np import numpy_support

#: Places in an array's description (Numba's format).
_OWNER, _ITEM_SIZE = 0, 3
_HALF = llvm.IntType(32)
_MISMATCH = "can't unbox array from PyObject into native value.  The object maybe of a different type"


def add_wrapper(lower: Any, release_gil: bool) -> None:
    """Add the wrapper of a lowered function to its library."""
    context, described = lower.context, lower.fndesc
    module = context.create_module("wrapper")
    kind = context.call_conv.get_function_type(described.restype, described.argtypes)
    function = llvm.Function(module, kind, described.llvm_func_name)
    _Wrapper(context, module, function, described, lower.env, lower.call_helper, release_gil).build()
    lower.library.add_ir_module(module)


def _is_array(kind: Any) -> bool:
    return type(kind) is types.Array and isinstance(kind.dtype, types.Number | types.Boolean)


def _is_plain(kind: Any) -> bool:
    """Whether a type owns nothing."""
    if isinstance(kind, types.Tuple | types.UniTuple):
        return all(map(_is_plain, kind.types))
    return isinstance(kind, types.Number | types.Boolean | types.NoneType)


def _is_tag(kind: Any) -> bool:
    """Whether a type is that of a tuple of nothing, which is there for its length alone."""
    return isinstance(kind, types.UniTuple) and isinstance(kind.dtype, types.NoneType)


class _Wrapper(PyCallWrapper):
    """Numba's, with short code for arrays."""

    def build_wrapper(self, api: Any, builder: Any, closure: Any, args: Any, kws: Any) -> None:
        """Write the wrapper."""
        kinds = self.fndesc.argtypes
        if not all(_is_array(kind) or _is_plain(kind) for kind in kinds):
            super().build_wrapper(api, builder, closure, args, kws)
            return
        objects = [api.alloca_obj() for _ in kinds]
        arrays = {place: self._room(builder, kind) for place, kind in enumerate(kinds) if _is_array(kind)}
        is_parsed = api.unpack_tuple(args, self.fndesc.qualname, len(kinds), len(kinds), *objects)
        with cgutils.if_unlikely(builder, cgutils.is_null(builder, is_parsed)):
            builder.ret(api.get_null_object())
        environment = self.get_env(api, builder)
        mismatch, end = (builder.append_basic_block(name) for name in ("mismatch", "end"))
        values: list[Any] = []
        for place, kind in enumerate(kinds):
            if place in arrays:
                self._read_array(api, builder, builder.load(objects[place]), arrays[place], kind, mismatch)
                values.append(None)
            elif _is_tag(kind):
                values.append(llvm.Constant(self.context.get_value_type(kind), None))
            else:
                native = api.to_native_value(kind, builder.load(objects[place]))
                self._go_on_unless(builder, native.is_error, end)
                values.append(native.value)
        for place, array in arrays.items():
            values[place] = builder.load(array)
        self._call(api, builder, values, list(arrays.values()), environment)
        with builder.goto_block(mismatch):
            api.err_set_string("PyExc_TypeError", _MISMATCH)
            builder.branch(end)
        with builder.goto_block(end):
            self._let_go(builder, list(arrays.values()))
            builder.ret(api.get_null_object())

    def _call(self, api: Any, builder: Any, values: list[Any], arrays: list[Any], environment: Any) -> None:
        """Call the function, let go of the arrays, and return or raise."""
        described, convention = self.fndesc, self.context.call_conv
        thread = api.save_thread() if self.release_gil else None
        status, returned = convention.call_function(
            builder, self.func, described.restype, described.argtypes, values, attrs=("noinline",)
        )
        if thread is not None:
            api.restore_thread(thread)
        self._let_go(builder, arrays)
        with builder.if_then(status.is_ok, likely=True):
            with builder.if_then(status.is_none):
                api.return_none()
            builder.ret(api.from_native_return(self._simplified_return_type(), returned, environment))
        convention.raise_error(builder, api, status)
        builder.ret(api.get_null_object())

    def _room(self, builder: Any, kind: Any) -> Any:
        """Make room for the description of an array, which owns nothing yet."""
        room = builder.alloca(self.context.get_value_type(kind))
        owner = self._field(builder, room, _OWNER)
        builder.store(llvm.Constant(owner.type.pointee, None), owner)
        return room

    def _read_array(self, api: Any, builder: Any, given: Any, room: Any, kind: Any, mismatch: Any) -> None:
        """Take an array from Python."""
        failed = api.nrt_adapt_ndarray_from_python(given, builder.bitcast(room, api.voidptr))
        size = builder.load(self._field(builder, room, _ITEM_SIZE))
        wanted = llvm.Constant(size.type, numpy_support.as_dtype(kind.dtype).itemsize)
        differs = builder.icmp_unsigned("!=", size, wanted)
        self._go_on_unless(builder, builder.or_(cgutils.is_not_null(builder, failed), differs), mismatch)

    def _let_go(self, builder: Any, arrays: list[Any]) -> None:
        """Count one reference less to each array that was taken; Numba's function does nothing for others."""
        release = cgutils.get_or_insert_function(builder.module, incref_decref_ty, "NRT_decref")
        for attribute in ("noalias", "captures(none)"):
            release.args[0].add_attribute(attribute)
        for array in arrays:
            builder.call(release, [builder.load(self._field(builder, array, _OWNER))])

    @staticmethod
    def _field(builder: Any, room: Any, place: int) -> Any:
        return builder.gep(room, [llvm.Constant(_HALF, 0), llvm.Constant(_HALF, place)], inbounds=True)

    @staticmethod
    def _go_on_unless(builder: Any, condition: Any, elsewhere: Any) -> None:
        """Go elsewhere on a condition, and continue in a block of its own."""
        further = builder.append_basic_block()
        builder.cbranch(condition, elsewhere, further)
        builder.position_at_end(further)
