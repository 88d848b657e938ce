# SPDX-License-Identifier: BSD-3-Clause
"""What the compiler is told sooner is what Numba finds out; arguments come back as they were."""

import itertools
import math
import operator
import sys
import warnings

import llvmlite.binding as llvm
import numba
import numpy as np
import pytest
from llvmlite import ir
from numba import extending
from numba.core import compiler, errors, event, ssa, types
from numba.core.registry import cpu_target
from numba.core.typed_passes import type_inference_stage
from numba.core.typeinfer import CallConstraint

from groma._kernels import shortcuts
from groma._numba import loop
from groma._simd import width

pytestmark = [pytest.mark.kernels, pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")]


@loop
def _longest(values, sizes, _shape):
    best = -1.0
    for i in range(values.shape[0]):
        row = values[i]
        best = max(best, row[0] * row[0] + sizes[0][i])
    return best


@loop
def _given_back(values):
    return values, values[1:]


@loop
def _until_negative(values):
    k = 0
    for i in range(values.shape[0]):
        step = values[i]
        if step < 0.0:
            k = i
            break
        last = step
    else:
        last = 0.0
    return k + last


def test_arguments_come_back_as_they_were():
    values, sizes = np.array([[1.0, 0.0], [3.0, 0.0]]), (np.array([5.0, 7.0]),)
    before = sys.getrefcount(values), sys.getrefcount(sizes[0])
    for _ in range(3):
        assert _longest(values, sizes, width(3)) == 16.0
    assert (sys.getrefcount(values), sys.getrefcount(sizes[0])) == before


@loop
def _of_each_kind(number, single, count, short, is_set, nothing, pairs):
    (first, second), third = pairs
    total = number + single + count + short + first + second[0] + third
    return total if is_set and nothing is None else -total


def test_arguments_of_each_kind():
    pairs = (1, np.array([2.0])), 4.0
    for count in (8, np.int64(8), True):
        found = _of_each_kind(0.5, np.float32(0.25), count, np.int16(-16), np.bool_(True), None, pairs)
        assert found == 0.5 + 0.25 + int(count) - 16 + 1 + 2 + 4
    assert _of_each_kind(np.float64(1.0), np.float32(0.0), 2**40, np.int16(0), False, None, pairs) == -(8.0 + 2**40)


def test_what_is_returned_of_an_argument_outlives_it():
    values = np.arange(1000.0)
    whole, part = _given_back(values)
    assert whole is values
    before = part.copy()
    del values, whole
    np.full(1000, -1.0)  # would take the memory
    np.testing.assert_array_equal(part, before)


def test_numbers_that_are_set_in_one_branch_only():
    assert _until_negative(np.array([2.0, 3.0, -1.0])) == 2 + 3.0
    assert _until_negative(np.array([2.0, 3.0])) == 0.0


def test_operators_mean_what_they_mean_to_numba():
    context = cpu_target.typing_context
    context.refresh()
    add = context.resolve_value_type(operator.add)
    for one in (types.float64, types.int64, types.float32, types.boolean, types.float64[::1]):
        for other in (types.float64, types.int64, types.literal(3)):
            meant = context.resolve_function_type(add, (one, other), {})
            for _ in range(2):
                assert shortcuts._Typing(context).resolve_function_type(add, (one, other), {}) == meant


def _grows(n):
    total = 0
    for i in range(n):
        total = total + i
        if i > 3:
            total = total * 0.5
    return total


def _fills(n):
    found = np.empty(n)
    last = found[0]
    for i in range(n):
        found[i] = np.sqrt(i + last)
        if found[i] > 1.0:
            last = found[i]
            continue
        pair, number = (i, found), i
        last = pair[1][number]
    return found, last


def _appended(n):
    found = []
    for i in range(n):
        found.append((i, 1.5))
    return found


def _warning(n):
    return n


@extending.overload(_warning)
def _overload_of_warning(n):
    warnings.warn(errors.NumbaWarning("slow"), stacklevel=1)
    warnings.warn("another", stacklevel=1)
    return lambda n: n


def _types(function):
    context, target = cpu_target.typing_context, cpu_target.target_context
    return type_inference_stage(context, target, compiler.run_frontend(function), (types.int64,), None)[:3]


@pytest.mark.parametrize("function", (_grows, _fills, _appended))
def test_types_are_those_of_numba_in_fewer_steps(function, monkeypatch):
    applied = []
    resolve = CallConstraint.resolve
    monkeypatch.setattr(CallConstraint, "resolve", lambda *given, **more: applied.append(1) or resolve(*given, **more))
    cpu_target.typing_context.refresh()
    kinds, returned, calls = _types(function)
    of_numba = len(applied)
    with shortcuts.remembering():
        found, also_returned, also_calls = _types(function)
    assert (found, also_returned) == (kinds, returned)
    assert list(map(str, also_calls.values())) == list(map(str, calls.values()))
    assert len(applied) - of_numba < 0.75 * of_numba


def test_a_warning_is_told_where_it_happened():
    def calls(n):
        return _warning(n)

    with shortcuts.remembering(), warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        _types(calls)
    line = calls.__code__.co_firstlineno + 1
    assert [(str(one.message), one.lineno == line) for one in heard] == [("another", False), ("slow", True)]


def test_a_type_that_cannot_be_is_told():
    def mixes(n):
        found = "text"
        for i in range(n):
            found = found + i
        return found

    with shortcuts.remembering(), pytest.raises(errors.TypingError, match="add"):
        _types(mixes)


@pytest.mark.parametrize("function", (_grows, _fills))
def test_variables_are_renamed_as_numba_does_in_fewer_steps(function, monkeypatch):
    steps = []
    numbas = ssa._run_ssa_block_pass
    monkeypatch.setattr(ssa, "_run_ssa_block_pass", lambda *given: steps.append(given) or numbas(*given))

    def renamed():
        steps.clear()
        blocks = ssa.reconstruct_ssa(compiler.run_frontend(function)).blocks
        return [(label, str(line)) for label, block in blocks.items() for line in block.body], len(steps)

    lines, of_numba = renamed()
    with shortcuts.remembering():
        same, ours = renamed()
    assert same == lines
    assert ours < of_numba


def test_code_is_made_for_what_operators_mean_to_numba():
    context = cpu_target.typing_context
    context.refresh()
    kinds = types.float64, types.int64, types.float32, types.boolean, types.literal(3), types.float64[::1]
    for one in (operator.add, operator.truediv, operator.lt, operator.pow, max):
        function = context.resolve_value_type(one)
        for pair in itertools.product(kinds[: -1 if one is max else None], repeat=2):
            meant = function.get_call_type(context, pair, {})
            with shortcuts.remembering():
                found = [function.get_call_type(context, pair, {}) for _ in range(2)]
            assert found == [meant, meant]


def test_who_listens_to_calls_of_llvm_hears_them():
    with event.install_recorder("numba:llvm_lock") as heard, shortcuts.remembering():
        llvm.parse_assembly("")
    assert heard.buffer
    with shortcuts.remembering():
        assert not llvm.ffi.lib._lock._cblist
    assert llvm.ffi.lib._lock._cblist


def test_setting_and_attributes_mean_what_they_mean_to_numba():
    context, array = cpu_target.typing_context, types.float64[:, ::1]
    ours = shortcuts._Typing(context)
    for index, value in ((types.literal(1), types.float64[::1]), (types.UniTuple(types.int32, 2), types.int64)):
        for _ in range(2):
            assert ours.resolve_setitem(array, index, value) == context.resolve_setitem(array, index, value)
    for attribute in ("shape", "size", "T", "nothing_of_this_name"):
        for _ in range(2):
            assert ours.resolve_getattr(array, attribute) == context.resolve_getattr(array, attribute)


@loop
def _finite(a, b):
    z = complex(a - b, a)
    return np.isfinite(a - b), math.isfinite(a * b + a), np.isfinite(np.array([a - b]))[0], np.isfinite(z)


@pytest.mark.parametrize("b", [1.0, np.inf, -np.inf, np.nan])
@pytest.mark.parametrize("a", [0.0, 1.7e308, np.inf, np.nan])
def test_sums_are_finite_only_if_they_are(a, b):
    """Numba's own test, whether a sum less the same sum is a number, is true of all once operations are regrouped."""
    with np.errstate(invalid="ignore", over="ignore"):
        assert _finite(a, b) == _finite.py_func(np.float64(a), np.float64(b))


def test_options_are_those_of_numba():
    flags = compiler.Flags()
    flags.nrt, flags.error_model = True, "numpy"
    expected = flags.values()
    with shortcuts.remembering():
        assert flags.values() == expected
        assert list(flags.values()) == list(expected)
        assert flags == flags.copy()
        assert flags != compiler.Flags()


def test_what_is_registered_later_is_found():
    calls = []
    target = cpu_target.target_context

    def typed(context, argument):
        def lowered(context, builder, signature, arguments):
            calls.append(signature)
            return arguments[0]

        return argument(argument), lowered

    with shortcuts.remembering():
        target.refresh()
        assert target.groma_registered == shortcuts._num_registered(target)
        later = extending.intrinsic(typed)
        assert numba.njit(lambda x: later(x) + 1.0)(2.0) == 3.0
    assert calls


def test_an_error_is_told_where_it_happened():
    @loop
    def wrong(values):
        return values + "text"

    with pytest.raises(numba.TypingError, match=r"(?s)No implementation of function.*During: typing of intrinsic-call"):
        wrong(np.zeros(3))


def test_what_was_put_into_a_tuple_is_not_taken_out_again():
    function = ir.Function(ir.Module(), ir.FunctionType(ir.VoidType(), [ir.DoubleType(), ir.IntType(1)]), "f")
    builder = ir.IRBuilder(function.append_basic_block())
    pair = ir.LiteralStructType([ir.DoubleType(), ir.IntType(1)])
    outer = ir.LiteralStructType([pair, ir.DoubleType()])
    with shortcuts.remembering():
        inner = ir.Constant(pair, ir.Undefined)
        for place, value in enumerate(function.args):
            inner = builder.insert_value(inner, value, place)
        whole = builder.insert_value(ir.Constant(outer, ir.Undefined), inner, 0)
        assert builder.extract_value(whole, (0, 0)) is function.args[0]
        assert builder.extract_value(inner, 0) is function.args[0]
        assert builder.extract_value(inner, 1).opname == "extractvalue"  # whether a loop goes on
        assert builder.extract_value(whole, 1).opname == "extractvalue"  # never put there
        deep = builder.insert_value(whole, function.args[0], (0, 0))
        assert builder.extract_value(deep, 0).opname == "extractvalue"  # put there in pieces
