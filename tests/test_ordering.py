# SPDX-License-Identifier: BSD-3-Clause
"""Order and median inside compiled loops, against NumPy; and that loops do without what takes long to compile."""

import ast
from pathlib import Path

import numpy as np
import pytest

import groma
from groma._ordering import ascending, median, sort_by

pytestmark = pytest.mark.kernels
#: Their compiled forms take a second or more each.
LONG = {"np.argsort", "np.sort", "np.median", "np.concatenate", "np.unique", "np.percentile", "np.quantile"}


def numbers(rng, count):
    """Numbers with many equal ones, or all different."""
    return rng.integers(0, count, count).astype(float) if count % 2 else rng.normal(size=count)


@pytest.mark.parametrize("count", [*range(1, 18), 31, 32, 33, 100, 255])
def test_order_and_median_are_those_of_numpy(count):
    rng = np.random.default_rng(count)
    for _ in range(5):
        values = numbers(rng, count)
        before = values.copy()
        np.testing.assert_array_equal(ascending(values), np.argsort(values, kind="stable"))
        assert median(values) == np.median(values)
        np.testing.assert_array_equal(values, before)


def test_equal_ones_stay_in_the_order_they_came():
    rng = np.random.default_rng(0)
    image, place = rng.integers(0, 4, 50), rng.integers(0, 9, 50).astype(float)
    order = ascending(place)
    sort_by(image, order)
    np.testing.assert_array_equal(order, np.lexsort((place, image)))


def test_infinite_and_sorted_numbers():
    values = np.array([np.inf, -1.0, np.inf, -np.inf])
    assert ascending(values).tolist() == [3, 1, 0, 2]
    assert median(np.array([np.inf, 1.0, 2.0])) == 2.0
    for values in (np.arange(40.0), np.arange(40.0)[::-1].copy(), np.zeros(41)):
        assert median(values) == np.median(values)


def compiled_functions():
    marks = {"kernel", "loop", "unrolled_loop", "inline_kernel", "exact_kernel"}
    for path in Path(groma.__file__).parent.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        for found in ast.walk(ast.parse(text)) if any(f"@{mark}" in text for mark in marks) else ():
            if isinstance(found, ast.FunctionDef) and marks & {
                getattr(mark, "id", "") for mark in found.decorator_list
            }:
                yield path.name, found


def dotted(node):
    """A name as it is written; nothing for what is no name."""
    return f"{dotted(node.value)}.{node.attr}" if isinstance(node, ast.Attribute) else getattr(node, "id", "")


def made_here(function):
    """Names of arrays that a function makes."""
    for part in ast.walk(function):
        if isinstance(part, ast.Assign):
            names, values = part.targets[0], part.value
            both = isinstance(names, ast.Tuple) and isinstance(values, ast.Tuple)
            for name, value in zip(names.elts, values.elts, strict=True) if both else [(names, values)]:
                if isinstance(value, ast.Call) and dotted(value.func) in ("np.empty", "np.zeros", "np.full"):
                    yield ast.unparse(name)


@pytest.mark.compiled
def test_compiled_loops_do_without_what_takes_long_to_compile():
    """Sorting and medians of NumPy, and rows copied by ``a[:] = b``: groma._ordering has short ones."""
    found = []
    for file, function in compiled_functions():
        arrays = set(made_here(function))
        for part in ast.walk(function):
            if isinstance(part, ast.Call) and dotted(part.func) in LONG:
                found.append(f"{file}, {function.name}: {ast.unparse(part)}")
            if isinstance(part, ast.Assign) and isinstance(part.targets[0], ast.Subscript):
                if ast.unparse(part.value).removesuffix(".T") in arrays:
                    found.append(f"{file}, {function.name}: {ast.unparse(part)}")
            if isinstance(part, ast.Assign) and any(isinstance(inside, ast.Slice) for target in part.targets
                                                    for inside in ast.walk(target)):  # fmt: skip
                if any(isinstance(inside, ast.Subscript) for inside in ast.walk(part.value)):
                    found.append(f"{file}, {function.name}: {ast.unparse(part)}")
    assert not found
