# SPDX-License-Identifier: BSD-3-Clause
"""Code for ranges with step 1, which stay in registers; part of :mod:`groma._kernels.elements`."""

from __future__ import annotations

from typing import Any

from llvmlite import ir as llvm
from numba.core import cgutils
from numba.core.lowering import Lower


class RangeLower(Lower):
    """Numba's, with short code for ranges."""

    def _range(self, expr: Any, kind: Any) -> Any:
        """Return start, end and step."""
        signature = self.fndesc.calltypes[expr]
        given = self.fold_call_args(self.typeof(expr.func.name), signature, expr.args, expr.vararg, expr.kws)
        word = given[0].type
        start, end, step = (word(0), *given, word(1)) if len(given) == 1 else (*given, word(1))[:3]
        return self._filled(self.context.get_value_type(kind), (start, end, step))

    def _start(self, state: Any, expr: Any, kind: Any) -> Any:
        """Return where a range has come to: a number, how many are left, and the step."""
        build: Any = self.builder
        start, end, step = (build.extract_value(state, place) for place in range(3))
        if not (isinstance(step, llvm.Constant) and step.constant == 1):
            return super().lower_expr(kind, expr)
        block = build.append_basic_block()  # as Numba does; without, LLVM orders blocks in another way
        build.branch(block)
        build.position_at_end(block)
        number, left = (cgutils.alloca_once(build, start.type) for _ in range(2))
        build.store(start, number)
        length = build.sub(end, start)
        is_empty = build.xor(build.icmp_signed(">", length, start.type(0)), cgutils.true_bit)
        with build.if_else(is_empty) as (then, otherwise):
            with then:
                build.store(start.type(0), left)
            with otherwise:
                build.store(length, left)
        return self._filled(self.context.get_value_type(kind), (number, end, step, left))

    def _next(self, state: Any, kind: Any) -> Any:
        """Return the next number, and whether there is one."""
        build: Any = self.builder
        number, _, step, left = (build.extract_value(state, place) for place in range(4))
        count = build.load(left)
        one = count.type(1)
        found = cgutils.alloca_once(build, count.type, zfill=True)
        is_there = build.icmp_signed(">", count, count.type(0))
        with build.if_then(is_there):
            value = build.load(number)
            build.store(value, found)
            build.store(build.sub(count, one, flags=["nsw"]), left)
            build.store(build.add(value, step), number)
        return self._filled(self.context.get_value_type(kind), (build.load(found), is_there))

    def _filled(self, kind: Any, parts: Any) -> Any:
        """Return a tuple of given parts."""
        value = kind(llvm.Undefined)
        for place, part in enumerate(parts):
            value = self.builder.insert_value(value, part, place)
        return value
