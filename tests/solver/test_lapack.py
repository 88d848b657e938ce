# SPDX-License-Identifier: BSD-3-Clause
"""The Cholesky factorisation that is looked up without scipy.linalg: what NumPy finds, and one module for both."""

import subprocess
import sys

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from groma.solver.linear.blas import one_blas_thread
from groma.solver.linear.lapack import potrf, potri, potrs, solve_lower


@pytest.fixture(scope="module")
def matrix():
    samples = np.random.default_rng(0).normal(size=(40, 12))
    return samples.T @ samples


def test_factor_solution_and_inverse(matrix):
    factor, info = potrf(matrix, lower=1, clean=1)
    assert info == 0
    np.testing.assert_allclose(factor, np.linalg.cholesky(matrix), rtol=1e-12, atol=1e-12)
    rhs = np.arange(24.0).reshape(12, 2)
    np.testing.assert_allclose(potrs(factor, rhs, lower=1)[0], np.linalg.solve(matrix, rhs), rtol=1e-10)
    inverse = np.tril(potri(factor, lower=1)[0])
    np.testing.assert_allclose(inverse, np.tril(np.linalg.inv(matrix)), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("columns", [0, 1, 5])
@pytest.mark.parametrize("transposed", [False, True])
def test_triangular_solutions(matrix, columns, transposed):
    factor = potrf(matrix, lower=1, clean=1)[0]
    rhs = np.random.default_rng(1).normal(size=(12, columns))
    found = solve_lower(factor, rhs, transposed)
    np.testing.assert_allclose((factor.T if transposed else factor) @ found, rhs, rtol=1e-10, atol=1e-10)


def test_what_is_not_positive_definite_is_told():
    assert potrf(-np.eye(3), lower=1)[1] > 0


@pytest.mark.parametrize("first", ["groma.solver.linear.lapack", "scipy.linalg.lapack"])
def test_scipy_has_the_same_module_whoever_loads_it_first(first):
    code = (
        f"import {first}\nimport scipy.linalg.lapack as theirs, groma.solver.linear.lapack as ours\n"
        "assert ours.potrf is theirs.dpotrf"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def blas_threads():
    return {entry["num_threads"] for entry in threadpool_info() if entry["user_api"] == "blas"}


def test_the_limit_ends_with_the_last_of_overlapping_contexts():
    with threadpool_limits(2, "blas"):
        before, first, second = blas_threads(), one_blas_thread(), one_blas_thread()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert blas_threads() == {1}
        second.__exit__(None, None, None)
        assert blas_threads() == before
