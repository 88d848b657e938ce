# SPDX-License-Identifier: BSD-3-Clause
r"""Small dense block products as explicit vector instructions.

Bundle adjustment spends its time in products of tiny blocks (3x9, 9x9). LLVM does not vectorise Numba's loops over
them, because a store might alias a load. Here the blocks are loaded into vector registers by hand.

Block sizes must be known when a loop is compiled. They are passed as *widths*: a tuple of ``None`` whose length is
the size, ``width(9) == (None,) * 9``. The size is then part of the argument's type, so one loop at module level is
compiled once for each size and cached on disk as such.

What is rarely done is not worth a loop for each size: :func:`any_width` stands for a size that is known when the loop
runs, an array of that length. The product of two blocks then goes number by number, with the same result to the last
bit; that with a vector is summed from left to right.

With ``NUMBA_DISABLE_JIT=1`` the same names are plain NumPy.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, config, types
from numba.extending import intrinsic

from groma._typing import BoolArray

_I32, _I64 = ir.IntType(32), ir.IntType(64)
_DOUBLE = ir.DoubleType()
#: Blocks that are not worth a loop of their own, which takes a tenth of a second to compile; without it a product takes
#: 30 nanoseconds more (cost: time only).
_FEW = 1024


def width(size: int) -> tuple[None, ...]:
    """Return the tuple whose type tells a compiled loop the block size."""
    return (None,) * size


@cache
def any_width(size: int) -> BoolArray:
    """Return the array whose length tells a compiled loop the block size; its type says nothing of it."""
    return np.zeros(size, dtype=bool)


def width_for(count: int, most: int) -> Callable[[int], Any]:
    """Return :func:`width`, or :func:`any_width` where blocks are few, and few beside the most of their kind."""
    return any_width if count < min(_FEW, most // 4) else width  # cost: time only


class _Vectors:
    """LLVM vectors of ``lanes`` doubles at unaligned addresses."""

    def __init__(self, builder: ir.IRBuilder, lanes: int) -> None:
        self.builder = builder
        self.type = ir.VectorType(_DOUBLE, lanes)
        self.lanes = lanes
        module = builder.module
        self._fma = cgutils.get_or_insert_function(
            module, ir.FunctionType(self.type, [self.type] * 3), f"llvm.fma.v{lanes}f64"
        )
        self._sum = cgutils.get_or_insert_function(
            module, ir.FunctionType(_DOUBLE, [_DOUBLE, self.type]), f"llvm.vector.reduce.fadd.v{lanes}f64"
        )

    def load(self, pointer) -> Any:
        value: Any = self.builder.load(self.builder.bitcast(pointer, self.type.as_pointer()))
        value.align = 8
        return value

    def load_single(self, pointer) -> Any:
        """Load single-precision numbers as doubles."""
        type_ = ir.VectorType(ir.FloatType(), self.lanes)
        value: Any = self.builder.load(self.builder.bitcast(pointer, type_.as_pointer()))
        value.align = 4
        return self.builder.fpext(value, self.type)

    def store(self, value, pointer) -> None:
        store: Any = self.builder.store(value, self.builder.bitcast(pointer, self.type.as_pointer()))
        store.align = 8

    def splat(self, scalar):
        undefined = ir.Constant(self.type, ir.Undefined)
        first = self.builder.insert_element(undefined, scalar, ir.Constant(_I32, 0))
        return self.builder.shuffle_vector(
            first, undefined, ir.Constant(ir.VectorType(_I32, self.lanes), [0] * self.lanes)
        )

    def fma(self, a, b, c):
        return self.builder.call(self._fma, [a, b, c])

    def sum(self, value):
        total = self.builder.call(self._sum, [ir.Constant(_DOUBLE, 0.0), value])
        total.fastmath.add("reassoc")
        return total


def _pointer(context, builder, array_type, array, offset):
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [offset])


def _product_codegen(context, builder, signature, args, accumulate: bool):
    if any(isinstance(kind, types.Array) for kind in signature.args[8:]):
        return _product_by_numbers(context, builder, signature, args, accumulate)
    depth, rows, lanes = (signature.args[i].count for i in (8, 9, 10))
    vectors = _Vectors(builder, lanes)
    C = _pointer(context, builder, signature.args[0], args[0], args[1])
    A = _pointer(context, builder, signature.args[2], args[2], args[3])
    B = _pointer(context, builder, signature.args[5], args[5], args[6])
    A_rows, B_rows = [A], [B]
    for _ in range(1, depth):
        A_rows.append(builder.gep(A_rows[-1], [args[4]]))
        B_rows.append(builder.gep(B_rows[-1], [args[7]]))
    b = [vectors.load(row) for row in B_rows]
    a = [[builder.load(builder.gep(row, [ir.Constant(_I64, i)])) for row in A_rows] for i in range(rows)]
    for i in range(rows):
        target = builder.gep(C, [ir.Constant(_I64, i * lanes)])
        total = vectors.load(target) if accumulate else None
        for k in range(depth):
            factor = vectors.splat(a[i][k])
            total = builder.fmul(factor, b[k]) if total is None else vectors.fma(factor, b[k], total)
        vectors.store(total, target)
    return context.get_dummy_value()


def _length(context, builder, kind, value):
    """Return the size that a width stands for."""
    if isinstance(kind, types.Array):
        return cgutils.unpack_tuple(builder, context.make_array(kind)(context, builder, value).shape)[0]
    return ir.Constant(_I64, kind.count)


def _product_by_numbers(context, builder, signature, args, accumulate: bool):
    """Do the same, in the same order, for sizes that are known when it runs."""
    depth, rows, lanes = (_length(context, builder, signature.args[i], args[i]) for i in (8, 9, 10))
    C, A, B = (_pointer(context, builder, signature.args[i], args[i], args[i + 1]) for i in (0, 2, 5))
    fma = cgutils.get_or_insert_function(builder.module, ir.FunctionType(_DOUBLE, [_DOUBLE] * 3), "llvm.fma.f64")
    total = cgutils.alloca_once(builder, _DOUBLE)
    first = ir.Constant(_I64, 0 if accumulate else 1)
    with cgutils.for_range(builder, rows) as row, cgutils.for_range(builder, lanes) as lane:
        column, other = builder.gep(A, [row.index]), builder.gep(B, [lane.index])
        target = builder.gep(C, [builder.add(builder.mul(row.index, lanes), lane.index)])
        start = builder.load(target) if accumulate else builder.fmul(builder.load(column), builder.load(other))
        builder.store(start, total)
        with cgutils.for_range_slice(builder, first, depth, ir.Constant(_I64, 1)) as (k, _):
            factors = [builder.load(builder.gep(p, [builder.mul(k, args[i])])) for p, i in ((column, 4), (other, 7))]
            builder.store(builder.call(fma, [*factors, builder.load(total)]), total)
        builder.store(builder.load(total), target)
    return context.get_dummy_value()


def _matvec_by_numbers(context, builder, signature, args):
    """Do y += A x for sizes that are known when it runs, each sum from left to right."""
    rows, lanes = (_length(context, builder, signature.args[i], args[i]) for i in (6, 7))
    y, A, x = (_pointer(context, builder, signature.args[i], args[i], args[i + 1]) for i in (0, 2, 4))
    total = cgutils.alloca_once(builder, _DOUBLE)
    with cgutils.for_range(builder, rows) as row:
        builder.store(ir.Constant(_DOUBLE, 0.0), total)
        with cgutils.for_range(builder, lanes) as lane:
            factor = builder.load(builder.gep(A, [builder.add(builder.mul(row.index, lanes), lane.index)]))
            factor = builder.fpext(factor, _DOUBLE) if factor.type != _DOUBLE else factor
            product = builder.fmul(factor, builder.load(builder.gep(x, [lane.index])))
            builder.store(builder.fadd(builder.load(total), product), total)
        target = builder.gep(y, [row.index])
        builder.store(builder.fadd(builder.load(target), builder.load(total)), target)
    return context.get_dummy_value()


def _product_signature(args):
    return types.void(*args)


@intrinsic
def _add_product(typing, C, c0, A, a0, a_stride, B, b0, b_stride, depth, rows, lanes):
    def codegen(context, builder, signature, args):
        return _product_codegen(context, builder, signature, args, accumulate=True)

    return _product_signature((C, c0, A, a0, a_stride, B, b0, b_stride, depth, rows, lanes)), codegen


@intrinsic
def _set_product(typing, C, c0, A, a0, a_stride, B, b0, b_stride, depth, rows, lanes):
    def codegen(context, builder, signature, args):
        return _product_codegen(context, builder, signature, args, accumulate=False)

    return _product_signature((C, c0, A, a0, a_stride, B, b0, b_stride, depth, rows, lanes)), codegen


@intrinsic
def _add_matvec(typing, y, y0, A, a0, x, x0, rows, lanes):
    signature = types.void(y, y0, A, a0, x, x0, rows, lanes)

    def codegen(context, builder, signature, args):
        if isinstance(rows, types.Array):
            return _matvec_by_numbers(context, builder, signature, args)
        num_rows, num_lanes = signature.args[6].count, signature.args[7].count
        vectors = _Vectors(builder, num_lanes)
        y_pointer = _pointer(context, builder, signature.args[0], args[0], args[1])
        A_pointer = _pointer(context, builder, signature.args[2], args[2], args[3])
        x_value = vectors.load(_pointer(context, builder, signature.args[4], args[4], args[5]))
        sums = []
        single = signature.args[2].dtype == types.float32
        for i in range(num_rows):
            place = builder.gep(A_pointer, [ir.Constant(_I64, i * num_lanes)])
            row = vectors.load_single(place) if single else vectors.load(place)
            sums.append(vectors.sum(builder.fmul(row, x_value)))
        for i, value in enumerate(sums):
            target = builder.gep(y_pointer, [ir.Constant(_I64, i)])
            builder.store(builder.fadd(builder.load(target), value), target)
        return context.get_dummy_value()

    return signature, codegen


def _blocks(C, c0, *factors):
    A, a0, a_stride, B, b0, b_stride, depth, rows, lanes = factors
    A, B, C = A.reshape(-1), B.reshape(-1), C.reshape(-1)
    m, p, q = len(depth), len(rows), len(lanes)
    first = [A[a0 + k * a_stride : a0 + k * a_stride + p] for k in range(m)]
    second = [B[b0 + k * b_stride : b0 + k * b_stride + q] for k in range(m)]
    product = np.stack(first).T @ np.stack(second)
    return C[c0 : c0 + p * q], product.reshape(-1)


def _add_product_plain(*arguments):
    target, product = _blocks(*arguments)
    target += product


def _set_product_plain(*arguments):
    target, product = _blocks(*arguments)
    target[:] = product


def _add_matvec_plain(y, y0, A, a0, x, x0, rows, lanes):
    p, q = len(rows), len(lanes)
    y[y0 : y0 + p] += A.reshape(-1)[a0 : a0 + p * q].reshape(p, q) @ x[x0 : x0 + q]


_plain = bool(config.DISABLE_JIT)  # type: ignore[attr-defined]

#: ``add_product(C, c0, A, a0, a_stride, B, b0, b_stride, depth, rows, lanes)``: C += A^T B for contiguous float64
#: arrays, at element offsets. A is depth x rows and B depth x lanes, with the given distances between their rows; C is
#: rows x lanes without gaps. The last three arguments are widths.
add_product: Callable[..., None] = _add_product_plain if _plain else _add_product
#: As :data:`add_product`, but C = A^T B.
set_product: Callable[..., None] = _set_product_plain if _plain else _set_product
#: ``add_matvec(y, y0, A, a0, x, x0, rows, lanes)``: y += A x for the rows x lanes block A, without gaps; A may be
#: float32.
add_matvec: Callable[..., None] = _add_matvec_plain if _plain else _add_matvec
