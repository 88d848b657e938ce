"""Vector block products against NumPy, for the block sizes that occur and at unaligned offsets."""

import numpy as np
import pytest

from groma._numba import loop
from groma._simd import add_matvec, add_product, any_width, set_product, width, width_for

pytestmark = pytest.mark.kernels


@loop
def _call_add(C, c0, A, a0, a_stride, B, b0, b_stride, depth, rows, lanes):
    add_product(C, c0, A, a0, a_stride, B, b0, b_stride, depth, rows, lanes)


@loop
def _call_set(C, c0, A, a0, a_stride, B, b0, b_stride, depth, rows, lanes):
    set_product(C, c0, A, a0, a_stride, B, b0, b_stride, depth, rows, lanes)


@loop
def _call_matvec(y, y0, A, a0, x, x0, rows, lanes):
    add_matvec(y, y0, A, a0, x, x0, rows, lanes)


@pytest.mark.parametrize(("depth", "rows", "lanes"), [(1, 1, 1), (2, 3, 9), (3, 6, 6), (4, 4, 10), (2, 1, 5)])
def test_products(depth, rows, lanes):
    rng = np.random.default_rng(depth * 100 + rows * 10 + lanes)
    a_stride, b_stride, offset = rows + 3, lanes + 2, 5
    A, B = rng.normal(size=offset + depth * a_stride), rng.normal(size=offset + depth * b_stride)
    C = rng.normal(size=offset + rows * lanes + 4)
    first = np.stack([A[offset + k * a_stride :][:rows] for k in range(depth)])
    second = np.stack([B[offset + k * b_stride :][:lanes] for k in range(depth)])
    product = (first.T @ second).reshape(-1)
    inside = slice(offset, offset + rows * lanes)
    for call, expected in ((_call_add, C[inside] + product), (_call_set, product)):
        target = C.copy()
        call(target, offset, A, offset, a_stride, B, offset, b_stride, width(depth), width(rows), width(lanes))
        np.testing.assert_allclose(target[inside], expected, rtol=1e-14, atol=1e-14)
        outside = np.ones(len(C), bool)
        outside[inside] = False
        np.testing.assert_array_equal(target[outside], C[outside])


@pytest.mark.parametrize(("depth", "rows", "lanes"), [(1, 1, 1), (2, 3, 9), (3, 6, 6), (4, 4, 10), (2, 1, 5)])
@pytest.mark.parametrize("call", [_call_add, _call_set])
def test_sizes_known_late_give_the_same_bits(call, depth, rows, lanes):
    rng = np.random.default_rng(depth * 100 + rows * 10 + lanes)
    A, B = rng.normal(size=1 + depth * (rows + 1)), rng.normal(size=2 + depth * (lanes + 3))
    C = rng.normal(size=3 + rows * lanes + 4)
    targets = []
    for sized in (width, any_width):
        target = C.copy()
        call(target, 3, A, 1, rows + 1, B, 2, lanes + 3, sized(depth), sized(rows), sized(lanes))
        targets.append(target)
    assert not np.array_equal(targets[0], C)
    assert targets[0].tobytes() == targets[1].tobytes()


def test_few_blocks_beside_many_have_no_loop_of_their_own():
    assert width_for(1000, 4004)(3) is any_width(3)
    assert width_for(1001, 4004)(3) == width(3)
    assert width_for(1024, 10**9)(3) == width(3)
    assert width_for(3, 3)(2) == width(2)


@pytest.mark.parametrize(("rows", "lanes"), [(1, 1), (3, 9), (4, 6), (6, 10)])
@pytest.mark.parametrize("sized", [width, any_width])
def test_matrix_times_vector(rows, lanes, sized):
    rng = np.random.default_rng(rows * 10 + lanes)
    A, x, y = rng.normal(size=2 + rows * lanes), rng.normal(size=3 + lanes), rng.normal(size=1 + rows)
    expected = y[1:] + A[2:].reshape(rows, lanes) @ x[3:]
    _call_matvec(y, 1, A, 2, x, 3, sized(rows), sized(lanes))
    np.testing.assert_allclose(y[1:], expected, rtol=1e-13, atol=1e-13)
