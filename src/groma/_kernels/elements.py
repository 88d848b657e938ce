# SPDX-License-Identifier: BSD-3-Clause
"""Code for numbers and parts of arrays, a fifth to a third as long as Numba's own.

Numba copies an array's description to the stack, unpacks all of it, and leaves it to LLVM to remove most. Kernels are
full of ``J[0, 3]`` and ``for i in range(n)``, so half of what LLVM parses and optimises, and much of what Python spends
on making it, is that. Here only the fields that are used are read, and a range stays in registers, as does a variable
that is assigned once. Addresses and counts are computed by the same formulas in the same blocks, so the machine code is
the same in nearly all functions.

Numba searches its rules for each ``a + b``; here that is one instruction. ``row[:] = 0.0`` compares shapes there, in
some 300 instructions, ``row[a:b]`` asks for the sign of the step in 150, and ``max(a, b)`` calls a function in 30.

In come Numba's statements; out comes ``NativeLowering``, the step of the compiler that turns them into LLVM's code.
Whatever is not part of an array by integers and a slice after them, or a range with step 1, goes the way of Numba, and
so do arrays if bounds are to be checked.
"""

from __future__ import annotations

import operator
from collections import Counter
from collections.abc import Callable
from functools import cache, cached_property, partial
from typing import Any

from llvmlite import ir as llvm
from numba.core import analysis, cgutils, ir, types
from numba.core.compiler_machinery import register_pass
from numba.core.debuginfo import DummyDIBuilder
from numba.core.typed_passes import NativeLowering as NumbaLowering

from groma._kernels.ranges import RangeLower

_WORD = llvm.IntType(64)
_ZERO, _HALF = llvm.Constant(_WORD, 0), llvm.IntType(32)
#: Places in an array's description (Numba's format).
_DATA, _SHAPE, _STRIDES = 4, 5, 6
#: What compares the largest and the least of numbers with the next.
_EXTREME = {max: ">", min: "<"}
#: What a loop over a range is made of, and numbers of arrays by fixed indices.
_PARTS = {"pair_first": 0, "pair_second": 1}
_COUNTING = ("static_getitem", "call", "getiter", "iternext", *_PARTS)
#: Numbers whose sums, products and comparisons are one instruction each, and what it is called.
_REAL, _WHOLE = frozenset((types.float32, types.float64)), frozenset((types.int32, types.int64))
_COMPUTED = {
    operator.add: ("fadd", "add"),
    operator.sub: ("fsub", "sub"),
    operator.mul: ("fmul", "mul"),
    operator.truediv: ("fdiv", ""),
}
_COMPARED = {
    operator.lt: "<",
    operator.le: "<=",
    operator.gt: ">",
    operator.ge: ">=",
    operator.eq: "==",
    operator.ne: "!=",
}


def _kinds(array: Any, index: Any) -> tuple[Any, ...] | None:
    """Return the types of the integers by which an index names part of an array, and of a slice after them.

    None for any other index.
    """
    if type(array) is not types.Array or not isinstance(array.dtype, types.Number | types.Boolean):
        return None
    kinds = tuple(index.types) if isinstance(index, types.Tuple | types.UniTuple) else (index,)
    whole = kinds[:-1] if kinds and kinds[-1] == types.slice2_type else kinds
    fits = 0 < len(kinds) <= array.ndim and all(isinstance(kind, types.Integer) for kind in whole)
    return kinds if fits else None


def _is_all(index: Any) -> bool:
    """Whether an index that is written in the code names all of an array."""
    return all(part == slice(None) for part in (index if type(index) is tuple else (index,)))


def _instruction(build: Any, op: Any, signature: Any) -> Callable[[Any, Any], Any] | None:
    """Return what makes the instruction for an operation on two numbers of one kind; None for any other operation."""
    kind, other = signature.args
    is_real = kind in _REAL
    if kind != other or not (is_real or kind in _WHOLE):
        return None
    if op in _COMPARED and signature.return_type == types.boolean:
        of_reals = build.fcmp_unordered if op is operator.ne else build.fcmp_ordered
        return partial(of_reals if is_real else build.icmp_signed, _COMPARED[op])
    name = _COMPUTED[op][not is_real] if op in _COMPUTED and signature.return_type == kind else ""
    return partial(getattr(build, name), flags=() if is_real else ("nsw",)) if name else None


def _assigned_before_use(blocks: Any) -> set[str]:
    """Return the variables that are assigned once, in a block through which every way to their uses leads."""
    assigned = Counter(found.target.name for block in blocks.values() for found in block.find_insts(ir.Assign))
    uses, definitions = analysis.compute_use_defs(blocks)
    above = analysis.compute_cfg_from_blocks(blocks).dominators()
    once = {name: offset for offset in blocks for name in definitions[offset] if assigned[name] == 1}
    elsewhere = {name for offset in blocks for name in uses[offset] if not _leads(once.get(name), offset, above)}
    return {name for name in once if name not in elsewhere} - analysis.must_use_alloca(blocks)


def _leads(start: int | None, offset: int, above: dict[int, set[int]]) -> bool:
    """Whether every way to a block leads through another, which is before it."""
    return start is not None and start < offset and start in above[offset]


def _product(build: Any, lengths: list[Any]) -> Any:
    """Return the product of lengths; None of none."""
    total = None
    for length in lengths:
        total = length if total is None else build.mul(total, length, flags=["nsw"])
    return total


@cache
def _is_counted(models: Any, kind: Any) -> bool:
    return models[kind].contains_nrt_meminfo()


class _Lower(RangeLower):
    """Numba's, with short code for parts of arrays, ranges, and variables without a count of references."""

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

    def _find_singly_assigned_variable(self) -> None:
        """Find variables that stay in registers, which Numba grants inside one block only.

        Arrays are in memory as well, where their references are counted.
        """
        super()._find_singly_assigned_variable()
        self._held: set[str] = set()
        self._values: dict[str, Any] = {}
        identity = self.func_ir.func_id
        if self._is_plain and not identity.is_generator and not identity.code.co_exceptiontable:
            found = _assigned_before_use(self.blocks)
            self._held = {name for name in found - self._singly_assigned_vars if self._is_counted(self.typeof(name))}
            self._singly_assigned_vars.update(found - self._held)

    def loadvar(self, name: str) -> Any:
        """Return the value of a variable."""
        return self._values[name] if name in self._values else super().loadvar(name)

    def storevar(self, value: Any, name: str, argidx: int | None = None) -> None:
        """Store a number without reading what was there before."""
        kind = self.typeof(name)
        if not self._is_plain or (argidx is None and self._is_counted(kind)):
            super().storevar(value, name, argidx)
            if name in self._held:
                self._values[name] = value
            return
        if name in self._held:
            self._values[name] = value
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

    def lower_inst(self, inst: Any) -> None:
        """Write the same number to all of an array by one loop."""
        if type(inst) is not ir.StaticSetItem or not _is_all(inst.index) or not self._fill(inst.target, (), inst.value):
            super().lower_inst(inst)

    def lower_expr(self, resty: Any, expr: Any) -> Any:
        """Spare arrays the search for code for fixed indices, of which there is none; count by short code."""
        if expr.op not in _COUNTING:
            return super().lower_expr(resty, expr)
        kind: Any = self.typeof((expr.func if expr.op == "call" else expr.value).name)
        if expr.op == "static_getitem" and expr.index_var is not None:
            if type(kind) is types.Array:
                return self.lower_getitem(resty, expr, expr.value, expr.index_var, self.fndesc.calltypes[expr])
        elif expr.op == "call" and getattr(kind, "typing_key", None) in _EXTREME:
            if resty in _REAL | _WHOLE and len(expr.args) > 1 and not expr.vararg:
                if all(types.unliteral(self.typeof(one.name)) == resty for one in expr.args):
                    return self._extreme(_EXTREME[kind.typing_key], resty, expr.args)
        elif expr.op == "call" and isinstance(resty, types.RangeType) and getattr(kind, "typing_key", None) is range:
            return self._range(expr, resty)
        elif expr.op == "getiter" and isinstance(kind, types.RangeType):
            return self._start(self.loadvar(expr.value.name), expr, resty)
        elif expr.op == "iternext" and isinstance(kind, types.RangeIteratorType):
            return self._next(self.loadvar(expr.value.name), resty)
        elif expr.op in _PARTS and isinstance(kind, types.Pair) and not self._is_counted(resty):
            return self.builder.extract_value(self.loadvar(expr.value.name), _PARTS[expr.op])
        return super().lower_expr(resty, expr)

    def lower_binop(self, resty: Any, expr: Any, op: Any) -> Any:
        """Compute with numbers by one instruction, square by a product, and divide complex numbers as NumPy does.

        Numba has a loop for powers, and an error for complex division by zero, whatever it is told.
        """
        signature = self.fndesc.calltypes[expr]
        raises = self.context.error_model.raise_on_fp_zero_division
        instruction = None if raises else _instruction(self.builder, op, signature)
        kind, count = signature.return_type, self.typeof(expr.rhs.name)
        is_square = op is operator.pow and isinstance(count, types.IntegerLiteral) and count.literal_value == 2
        is_square &= isinstance(kind, types.Float | types.Integer) and kind == signature.args[0]
        if not is_square and instruction is None and not (op is operator.truediv and isinstance(kind, types.Complex)):
            return super().lower_binop(resty, expr, op)
        first, second = (
            self.context.cast(self.builder, self.loadvar(side.name), self.typeof(side.name), wanted)
            for side, wanted in zip((expr.lhs, expr.rhs), signature.args, strict=True)
        )
        build: Any = self.builder
        if instruction is not None:
            found = instruction(first, second)
        elif is_square:
            found = (build.fmul if isinstance(kind, types.Float) else build.mul)(first, first)
        else:
            from numba.np.npyfuncs import np_complex_div_impl

            found = np_complex_div_impl(self.context, build, signature, (first, second))
        return self.context.cast(build, found, kind, resty)

    def _extreme(self, comparison: str, kind: Any, names: Any) -> Any:
        """Return the largest or the least of some numbers, as Python finds it."""
        build: Any = self.builder
        compare = build.fcmp_ordered if kind in _REAL else build.icmp_signed
        found, *others = (
            self.context.cast(build, self.loadvar(one.name), self.typeof(one.name), kind) for one in names
        )
        for other in others:
            found = build.select(compare(comparison, other, found), other, found)
        return found

    def lower_getitem(self, resty: Any, expr: Any, value: Any, index: Any, signature: Any) -> Any:
        """Read one number, or name a part of an array by its first indices."""
        array = self.typeof(value.name)
        kinds, found = self._kinds(array, index), signature.return_type
        if kinds is not None and type(found) is types.Array:
            part = self._view(value.name, array, index.name, kinds)
            self.incref(found, part)
            return self.context.cast(self.builder, part, found, resty)
        if kinds is None or found != array.dtype:
            return super().lower_getitem(resty, expr, value, index, signature)
        from numba.np.arrayobj import load_item  # with much else that loaded code does not need

        found = load_item(self.context, self.builder, array, self._place(value.name, array, index.name, kinds))
        return self.context.cast(self.builder, found, array.dtype, resty)

    def lower_setitem(self, target_var: Any, index_var: Any, value_var: Any, signature: Any) -> Any:
        """Write one number, to one place or to all that the first indices name."""
        kinds = self._kinds(self.typeof(target_var.name), index_var)
        if kinds is None or not self._fill(target_var, kinds, value_var, index_var.name):
            super().lower_setitem(target_var, index_var, value_var, signature)

    def _fill(self, target: Any, kinds: tuple[Any, ...], value: Any, index_name: str = "") -> bool:
        """Write a number to part of an array; False where that is left to Numba."""
        array, kind = self.typeof(target.name), self.typeof(value.name)
        is_simple = type(array) is types.Array and isinstance(array.dtype, types.Number | types.Boolean)
        is_simple &= isinstance(types.unliteral(kind), types.Number | types.Boolean) and types.slice2_type not in kinds
        if not is_simple or (len(kinds) < array.ndim and array.layout != "C") or self.context.enable_boundscheck:
            return False
        from numba.np.arrayobj import store_item

        build: Any = self.builder
        number = self.context.cast(build, self.loadvar(value.name), kind, array.dtype)
        place = self._place(target.name, array, index_name, kinds) if kinds else self._field(target.name, _DATA)
        count = _product(build, [self._field(target.name, _SHAPE, axis) for axis in range(len(kinds), array.ndim)])
        if count is None:
            store_item(self.context, build, array, number, place)
            return True
        with cgutils.for_range(build, count) as loop:
            store_item(self.context, build, array, number, build.gep(place, [loop.index]))
        return True

    def _kinds(self, array: Any, index: Any) -> tuple[Any, ...] | None:
        """As above; None where Numba is asked to check bounds, too."""
        return None if self.context.enable_boundscheck else _kinds(array, self.typeof(index.name))

    def _view(self, name: str, array: Any, index_name: str, kinds: tuple[Any, ...]) -> Any:
        """Return the description of part of an array."""
        build: Any = self.builder
        place, axes = self._place(name, array, index_name, kinds), range(len(kinds), array.ndim)
        if kinds[-1] == types.slice2_type:
            axes = range(len(kinds) - 1, array.ndim)
        shape, strides = ([self._field(name, field, axis) for axis in axes] for field in (_SHAPE, _STRIDES))
        if kinds[-1] == types.slice2_type:
            index = self.loadvar(index_name)
            if isinstance(self.typeof(index_name), types.BaseTuple):
                index = build.extract_value(index, len(kinds) - 1)
            start, stop = (self._bound(build.extract_value(index, side), shape[0]) for side in range(2))
            shape[0] = build.sub(stop, start)
            shape[0] = build.select(build.icmp_signed("<", shape[0], _ZERO), _ZERO, shape[0])
        count = _product(build, shape)
        lengths = llvm.ArrayType(_WORD, len(axes))
        owner, parent, size = (self._field(name, field) for field in (0, 1, 3))
        packed = self._filled(lengths, shape), self._filled(lengths, strides)
        kind = self.context.get_value_type(array.copy(ndim=len(axes)))
        return self._filled(kind, (owner, parent, count, size, place, *packed))

    def _bound(self, index: Any, length: Any) -> Any:
        """Return an end of a slice, counted from the start, inside an array."""
        build: Any = self.builder
        index = build.select(build.icmp_signed("<", index, _ZERO), build.add(index, length), index)
        index = build.select(build.icmp_signed("<", index, _ZERO), _ZERO, index)
        return build.select(build.icmp_signed(">=", index, length), length, index)

    def _place(self, name: str, array: Any, index_name: str, kinds: tuple[Any, ...]) -> Any:
        """Return the address of a number, the first one if indices are missing."""
        build, index = self.builder, self.loadvar(index_name)
        is_one = not isinstance(self.typeof(index_name), types.BaseTuple)
        indices = []
        for axis, kind in enumerate(kinds):
            given = index if is_one else build.extract_value(index, axis)
            if kind == types.slice2_type:
                indices.append(self._bound(build.extract_value(given, 0), self._field(name, _SHAPE, axis)))
            else:
                indices.append(self._from_start(given, kind, name, axis))
        if array.layout == "A":
            steps = [self._field(name, _STRIDES, axis) for axis in range(len(kinds))]
            data = build.bitcast(self._field(name, _DATA), llvm.IntType(8).as_pointer())
            place = build.gep(data, [self._sum(indices, steps)])
            return build.bitcast(place, self.context.get_data_type(array.dtype).as_pointer())
        axes, steps = range(array.ndim), []
        for axis in axes[: len(kinds)]:
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
        if name in self._values or (name in self._blk_local_varmap and not self._disable_sroa_like_opt):
            return self.builder.extract_value(self.loadvar(name), path)
        steps = [llvm.Constant(_HALF, step) for step in (0, *path)]
        return self.builder.load(self.builder.gep(self.getvar(name), steps, inbounds=True))


@register_pass(mutates_CFG=True, analysis_only=False)
class NativeLowering(NumbaLowering):
    """The step of Numba's compiler, with that."""

    _name = "groma_native_lowering"

    @property
    def lowering_class(self) -> Any:
        return _Lower
