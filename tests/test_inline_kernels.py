# SPDX-License-Identifier: BSD-3-Clause
"""A loop in steps (``inline_kernel``) computes the bits of the loop written out, although sums may be regrouped."""

import numpy as np
import pytest

from groma._numba import inline_kernel, loop

pytestmark = pytest.mark.kernels


@inline_kernel
def _weighted_mean(weights, values, count):
    total, mean = 0.0, 0.0
    for k in range(count):
        total += weights[k]
        mean += weights[k] * values[k]
    return total, mean / total


@inline_kernel
def _moments(weights, values, count, mean, out):
    out[:] = 0.0
    for k in range(count):
        away = values[k] - mean
        if not abs(away) < 3.0:
            return False
        out[0] += weights[k] * away * away
        out[1] += weights[k] * away * away * away
    return True


@loop
def _in_steps(weights, values, results):
    out = np.empty(2)
    for row in range(values.shape[0]):
        total, mean = _weighted_mean(weights, values[row], values.shape[1])
        if not _moments(weights, values[row], values.shape[1], mean, out):
            continue
        results[row, 0], results[row, 1] = out[0] / total, out[1] / total


@loop
def _written_out(weights, values, results):
    out = np.empty(2)
    for row in range(values.shape[0]):
        total, mean = 0.0, 0.0
        for k in range(values.shape[1]):
            total += weights[k]
            mean += weights[k] * values[row, k]
        mean /= total
        out[:] = 0.0
        inside = True
        for k in range(values.shape[1]):
            away = values[row, k] - mean
            if not abs(away) < 3.0:
                inside = False
                break
            out[0] += weights[k] * away * away
            out[1] += weights[k] * away * away * away
        if not inside:
            continue
        results[row, 0], results[row, 1] = out[0] / total, out[1] / total


def test_steps_compute_the_bits_of_the_loop_written_out():
    rng = np.random.default_rng(0)
    weights, values = rng.uniform(0.1, 1.0, 101), rng.normal(size=(400, 101))
    steps, whole = np.full((400, 2), -1.0), np.full((400, 2), -1.0)
    _in_steps(weights, values, steps)
    _written_out(weights, values, whole)
    np.testing.assert_array_equal(steps, whole)
    mean = values @ weights / weights.sum()
    inside = (np.abs(values - mean[:, None]) < 3.0).all(axis=1)
    assert 100 < inside.sum() < 400 and (steps[~inside] == -1.0).all()
    variance = ((values - mean[:, None]) ** 2 @ weights / weights.sum())[inside]
    np.testing.assert_allclose(steps[inside, 0], variance, rtol=1e-12)
