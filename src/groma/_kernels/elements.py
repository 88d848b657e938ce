# SPDX-License-Identifier: BSD-3-Clause
"""Code for reading and writing one number of an array, a fifth as long as Numba's own.

Numba copies an array's description to the stack, unpacks all of it, and leaves it to LLVM to remove most. Kernels are
full of ``J[0, 3]``, so half of what LLVM parses and optimises, and much of what Python spends on making it, is that.
Here only the fields that are used are read. The address is computed by the same formula, so the numbers are the same.

In come Numba's statements; out comes ``NativeLowering``, the step of the compiler that turns them into LLVM's code.
Whatever is not one number of an array by integers goes the way of Numba, and so does all if bounds are to be checked.
"""

from __future__ import annotations

from functools import cache, cached_property
from typing import Any

from llvmlite import ir as llvm
from numba.core import cgutils, types
from numba.core.compiler_machinery import register_pass
from numba.core.debuginfo import DummyDIBuilder
from numba.core.lowering import Lower
from numba.core.typed_passes import NativeLowering as NumbaLowering

_WORD = llvm.IntType(64)
_ZERO, _HALF = llvm.Constant(_WORD, 0), llvm.IntType(32)
#: Places in an array's description (Numba's format).
_DATA, _SHAPE, _STRIDES = 4, 5, 6


def _kinds(array: Any, index: Any) -> tuple[Any, ...] | None:
    """Return the types of the integers by which an index names one number of an array; None for any other index."""
    if type(array) is not types.Array or not isinstance(array.dtype, types.Number | types.Boolean):
        return None
    kinds = tuple(index.types) if isinstance(index, types.Tuple | types.UniTuple) else (index,)
    fits = len(kinds) == array.ndim and all(isinstance(kind, types.Integer) for kind in kinds)
    return kinds if fits else None


def _item(value: Any, place: int) -> Any:
    """Return what was put at a place of a tuple, if that can be seen; None otherwise."""
    while isinstance(value, llvm.instructions.InsertValue):
        if value.indices[0] == place:
            return value.operands[1]
        value = value.operands[0]
    return None


@cache
def _is_counted(models: Any, kind: Any) -> bool:
    return models[kind].contains_nrt_meminfo()


class _Lower(Lower):
    """Numba's, with short code for numbers of arrays and for variables without a count of references."""

    @cached_property
    def _is_plain(self) -> bool:
        """Whether nobody wants to look at variables in a debugger."""
        return type(self.debuginfo) is DummyDIBuilder

    def _is_counted(self, kind: Any) -> bool:
        """Whether something of a type has a count of references."""
        return _is_counted(self.context.data_model_manager, kind)

    def incref(self, typ: Any, val: Any) -> None:
        """Count a reference, where there is something to be counted."""
        if self._is_counted(typ):
            super().incref(typ, val)

    def decref(self, typ: Any, val: Any) -> None:
        """Count one reference less, where there is something to be counted."""
        if self._is_counted(typ):
            super().decref(typ, val)

    def storevar(self, value: Any, name: str, argidx: int | None = None) -> None:
        """Store a number without reading what was there before."""
        kind = self.typeof(name)
        if not self._is_plain or (argidx is None and self._is_counted(kind)):
            super().storevar(value, name, argidx)
            return
        self._alloca_var(name, kind)
        if name in self._singly_assigned_vars and not self._disable_sroa_like_opt:
            self._blk_local_varmap[name] = value
        else:
            self.builder.store(value, self.getvar(name))

    def delvar(self, name: str) -> None:
        """Forget an array; a number may stay where it is."""
        if self._is_counted(self.typeof(name)):
            super().delvar(name)
        elif name not in self._blk_local_varmap:
            self._singly_assigned_vars.discard(name)

    def alloca_lltype(self, name: str, lltype: Any, datamodel: Any = None) -> Any:
        """Make room for a variable, without asking LLVM how much of it a debugger should show."""
        if not self._is_plain:
            return super().alloca_lltype(name, lltype, datamodel)
        return cgutils.alloca_once(self.builder, lltype, name=name, zfill=False)

    def lower_expr(self, resty: Any, expr: Any) -> Any:
        """Spare arrays the search for code for fixed indices, of which there is none."""
        if expr.op == "static_getitem" and expr.index_var is not None:
            if type(self.typeof(expr.value.name)) is types.Array:
                return self.lower_getitem(resty, expr, expr.value, expr.index_var, self.fndesc.calltypes[expr])
        return super().lower_expr(resty, expr)

    def lower_getitem(self, resty: Any, expr: Any, value: Any, index: Any, signature: Any) -> Any:
        """Read one number."""
        array = self.typeof(value.name)
        kinds = self._kinds(array, index)
        if kinds is None or signature.return_type != array.dtype:
            return super().lower_getitem(resty, expr, value, index, signature)
        from numba.np.arrayobj import load_item  # with much else that loaded code does not need

        found = load_item(self.context, self.builder, array, self._place(value.name, array, index.name, kinds))
        return self.context.cast(self.builder, found, array.dtype, resty)

    def lower_setitem(self, target_var: Any, index_var: Any, value_var: Any, signature: Any) -> Any:
        """Write one number."""
        array, kind = self.typeof(target_var.name), self.typeof(value_var.name)
        kinds = self._kinds(array, index_var)
        if kinds is None or not isinstance(types.unliteral(kind), types.Number | types.Boolean):
            return super().lower_setitem(target_var, index_var, value_var, signature)
        from numba.np.arrayobj import store_item

        value = self.context.cast(self.builder, self.loadvar(value_var.name), kind, array.dtype)
        store_item(self.context, self.builder, array, value, self._place(target_var.name, array, index_var.name, kinds))

    def _kinds(self, array: Any, index: Any) -> tuple[Any, ...] | None:
        """As above; None where Numba is asked to check bounds, too."""
        return None if self.context.enable_boundscheck else _kinds(array, self.typeof(index.name))

    def _place(self, name: str, array: Any, index_name: str, kinds: tuple[Any, ...]) -> Any:
        """Return the address of a number."""
        build, index = self.builder, self.loadvar(index_name)
        is_one = not isinstance(self.typeof(index_name), types.BaseTuple)
        indices = []
        for axis, kind in enumerate(kinds):
            given = index if is_one else _item(index, axis)
            given = build.extract_value(index, axis) if given is None else given
            indices.append(self._from_start(given, kind, name, axis))
        if array.layout == "A":
            steps = [self._field(name, _STRIDES, axis) for axis in range(array.ndim)]
            data = build.bitcast(self._field(name, _DATA), llvm.IntType(8).as_pointer())
            place = build.gep(data, [self._sum(indices, steps)])
            return build.bitcast(place, self.context.get_data_type(array.dtype).as_pointer())
        axes = range(array.ndim)
        steps = []
        for axis in axes:
            step = None
            for other in axes[axis + 1 :] if array.layout == "C" else axes[:axis]:
                length = self._field(name, _SHAPE, other)
                step = length if step is None else build.mul(step, length)
            steps.append(step)
        return build.gep(self._field(name, _DATA), [self._sum(indices, steps)])

    def _sum(self, indices: list[Any], steps: list[Any]) -> Any:
        """Return the sum of products; no step stands for 1."""
        total = None
        for index, step in zip(indices, steps, strict=True):
            if isinstance(index, llvm.Constant) and index.constant == 0:
                continue
            part = index if step is None else self.builder.mul(index, step)
            total = part if total is None else self.builder.add(total, part)
        return _ZERO if total is None else total

    def _from_start(self, index: Any, kind: Any, name: str, axis: int) -> Any:
        """Return an index counted from the start; negative ones count from the end."""
        if not kind.signed:
            return self.context.cast(self.builder, index, kind, types.uintp)
        index = self.context.cast(self.builder, index, kind, types.intp)
        if isinstance(index, llvm.Constant) and isinstance(index.constant, int) and index.constant >= 0:
            return index
        from_end = self.builder.add(self._field(name, _SHAPE, axis), index)
        return self.builder.select(self.builder.icmp_signed("<", index, _ZERO), from_end, index)

    def _field(self, name: str, *path: int) -> Any:
        """Return a field of the description of an array."""
        if name in self._blk_local_varmap and not self._disable_sroa_like_opt:
            return self.builder.extract_value(self._blk_local_varmap[name], path)
        steps = [llvm.Constant(_HALF, step) for step in (0, *path)]
        return self.builder.load(self.builder.gep(self.getvar(name), steps, inbounds=True))


@register_pass(mutates_CFG=True, analysis_only=False)
class NativeLowering(NumbaLowering):
    """The step of Numba's compiler, with that."""

    _name = "groma_native_lowering"

    @property
    def lowering_class(self) -> Any:
        return _Lower
