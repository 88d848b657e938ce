"""Sparse factorisation by blocks: the solution of dense systems, and the structure of known graphs."""

from types import SimpleNamespace

import numpy as np
import pytest

from groma.solver.linear.block_cholesky import BlockCholesky
from groma.solver.linear.ordering import fill_reducing_order

pytestmark = pytest.mark.kernels


def system(rng, count, width, pairs):
    """Blocks of a positive definite matrix with the given off-diagonal pairs, its layout and the matrix itself."""
    pairs = np.array(pairs, dtype=int).reshape(-1, 2)
    rows, columns = (np.concatenate([np.arange(count), pairs[:, side]]).astype(np.int32) for side in (0, 1))
    blocks = rng.normal(size=(len(rows), width, width))
    blocks[:count] = blocks[:count] @ blocks[:count].transpose(0, 2, 1) + 8.0 * width * np.eye(width)
    matrix = np.zeros((count, width, count, width))
    for block, row, column in zip(blocks, rows, columns, strict=True):
        matrix[row, :, column], matrix[column, :, row] = block, block.T
    layout = SimpleNamespace(kept=(SimpleNamespace(width=width, count=count),), blocks={(0, 0): (rows, columns)})
    return layout, blocks, matrix.reshape(count * width, count * width)


@pytest.mark.parametrize(
    ("count", "width", "pairs"),
    [
        (1, 6, []),
        (4, 6, []),
        (5, 6, [(i, i + 1) for i in range(4)]),
        (5, 3, [(i, j) for i in range(5) for j in range(i + 1, 5)]),
        (9, 6, [(i, (i + 1) % 9) if i < 8 else (0, 8) for i in range(9)]),
        (12, 7, [(0, i) for i in range(1, 12)]),
    ],
    ids=["one block", "no pairs", "chain", "full", "ring", "star"],
)
def test_solves_the_system(count, width, pairs):
    rng = np.random.default_rng(count * width)
    layout, blocks, matrix = system(rng, count, width, pairs)
    cholesky = BlockCholesky(layout)
    for _ in range(2):  # the second time over what the first has left
        rhs = rng.normal(size=count * width)
        given = rhs.copy()
        assert cholesky.factorize({(0, 0): blocks})
        np.testing.assert_allclose(matrix @ cholesky.solve(rhs), given, atol=1e-12)
        np.testing.assert_array_equal(rhs, given)
        blocks = blocks * 1.5
        matrix = matrix * 1.5


def test_random_graphs():
    rng = np.random.default_rng(3)
    for count, degree in ((20, 1), (20, 4)):
        ends = rng.integers(0, count, (count * degree, 2))
        pairs = np.unique(np.sort(ends[ends[:, 0] != ends[:, 1]], axis=1), axis=0)
        layout, blocks, matrix = system(rng, count, 6, pairs)
        cholesky = BlockCholesky(layout)
        assert cholesky.factorize({(0, 0): blocks})
        rhs = rng.normal(size=6 * count)
        np.testing.assert_allclose(cholesky.solve(rhs), np.linalg.solve(matrix, rhs), atol=1e-12)
        factor = np.linalg.cholesky(_connected(pairs, count, cholesky))
        assert cholesky.num_blocks == np.count_nonzero(np.abs(factor) > 1e-12)


def _connected(pairs, count, cholesky):
    """The graph as a positive definite matrix in the order of the elimination, without chance cancellation."""
    matrix = np.zeros((count, count))
    matrix[cholesky._position[pairs[:, 0]], cholesky._position[pairs[:, 1]]] = -1.0
    matrix += matrix.T
    return matrix + np.diag(1.0 - matrix.sum(axis=1))


def test_an_indefinite_system_is_refused():
    layout, blocks, _ = system(np.random.default_rng(0), 5, 6, [(i, i + 1) for i in range(4)])
    blocks[3, 2, 2] = -1.0
    assert not BlockCholesky(layout).factorize({(0, 0): blocks})
    blocks[3, 2, 2] = np.nan
    assert not BlockCholesky(layout).factorize({(0, 0): blocks})


def test_a_chain_is_eliminated_without_fill():
    count = 40
    shuffled = np.random.default_rng(1).permutation(count)
    chain = np.stack([shuffled[:-1], shuffled[1:]], axis=1)
    layout, _, _ = system(np.random.default_rng(0), count, 2, np.sort(chain, axis=1))
    cholesky = BlockCholesky(layout)
    assert cholesky.num_blocks == 2 * count - 1
    assert sorted(fill_reducing_order(chain[:, 0], chain[:, 1], count)) == list(range(count))
