# SPDX-License-Identifier: BSD-3-Clause
"""The order in which blocks of a sparse symmetric matrix are eliminated."""

from __future__ import annotations

import numpy as np

from groma._typing import IntArray


def fill_reducing_order(rows: IntArray, columns: IntArray, count: int) -> IntArray:
    """Return the place of each block in the elimination, by minimum degree.

    It is the ordering that SuperLU finds for the graph of the blocks, which is small and here diagonally dominant.

    Parameters
    ----------
    rows, columns : (B,) int
        Blocks off the diagonal, each pair once.
    count : int
        Number of block rows.
    """
    from scipy.sparse import csc_matrix  # takes a quarter of a second to import
    from scipy.sparse.linalg import splu

    degree = np.bincount(rows, minlength=count) + np.bincount(columns, minlength=count)
    every = np.arange(count)
    graph = csc_matrix(
        (
            np.concatenate([degree + 1.0, np.full(2 * len(rows), -1.0)]),
            (np.concatenate([every, rows, columns]), np.concatenate([every, columns, rows])),
        ),
        shape=(count, count),
    )
    factors = splu(graph, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.asarray(factors.perm_c, np.int64)
