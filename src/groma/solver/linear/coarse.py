# SPDX-License-Identifier: BSD-3-Clause
r"""A coarse space of camera clusters, the second level of the preconditioner of the reduced system.

What is slow in conjugate gradients on a long scene are the motions that cost next to nothing: a whole stretch of
cameras that drifts, turns or grows together. Cameras are grouped into clusters of neighbours, and each cluster may move
as the world does (:mod:`groma.problem.gauge`): seven columns P for each. With D the diagonal blocks of S, the
preconditioner is

.. math:: M^{-1} = D^{-1} + P\,(P^\top S P)^{-1} P^\top .

The first part evens out what differs between neighbours, the second what differs between clusters; the number of
iterations then depends little on the length of the scene. To form :math:`P^\top S P` costs a few products with S.

Nicolaides, *Deflation of conjugate gradients with applications to boundary value problems*, 1987; Kushal and Agarwal,
*Visibility based preconditioning for bundle adjustment*, 2012, for clusters of cameras.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from groma._numba import loop
from groma._rows import pointers_of
from groma._simd import add_matvec, add_product, set_product, width
from groma._typing import FloatArray, IntArray
from groma.problem.gauge import gauge_directions
from groma.problem.layout import Layout
from groma.problem.sorting import argsort_by
from groma.solver.linear.lapack import potrf, potrs
from groma.solver.linear.remote_blocks import RemoteBlocks

#: Cameras in a cluster, unless that makes more clusters than MAX_CLUSTERS (cost: of the coarse system; the solution is
#: the same).
CLUSTER_SIZE = 24
#: Cost: time only.
MAX_CLUSTERS = 64
#: Fewer clusters than this are not used (cost: time only).
MIN_CLUSTERS = 4
#: Relative addition to the diagonal of the coarse system: a single camera does not determine all seven motions.
JITTER = 1e-10
#: The coarse system is kept while the motions have changed by less than this share of the largest since it was formed
#: (cost: time only).
SAME_MOTIONS = 3e-3

# ---------------------------------------------------------------------------------------------------------- Kernels


@loop
def _grow(pointer, neighbor, size, cluster):
    """Number clusters of at most ``size`` neighbours, each grown breadth first from beside an earlier one."""
    count = pointer.shape[0] - 1
    queue = np.empty(count, np.int64)
    border = np.empty(neighbor.shape[0] + 1, np.int64)
    num_clusters, next_seed, border_begin, border_end = 0, 0, 0, 0
    while True:
        seed = -1
        while border_begin < border_end and seed < 0:
            if cluster[border[border_begin]] < 0:
                seed = border[border_begin]
            border_begin += 1
        while seed < 0 and next_seed < count:
            if cluster[next_seed] < 0:
                seed = next_seed
            next_seed += 1
        if seed < 0:
            return num_clusters
        cluster[seed], queue[0], head, tail = num_clusters, seed, 0, 1
        while head < tail:
            i = queue[head]
            head += 1
            for s in range(pointer[i], pointer[i + 1]):
                j = neighbor[s]
                if cluster[j] < 0:
                    if tail < size:
                        cluster[j] = num_clusters
                        queue[tail] = j
                        tail += 1
                    else:
                        border[border_end] = j
                        border_end += 1
        num_clusters += 1


@loop
def _coarse_matrix(S, rows, columns, cluster, P, A, Q, block_width, modes):
    """Add to A half of P^T S P for the upper blocks of S; A + A^T is the whole."""
    w, m = len(block_width), len(modes)
    clusters = np.int64(np.sqrt(A.shape[0] // (m * m)) + 0.5)
    for s in range(rows.shape[0]):
        i, j = np.int64(rows[s]), np.int64(columns[s])
        set_product(Q, 0, S, s * w * w, w, P, i * w * m, m, block_width, block_width, modes)
        if i == j:
            for k in range(w * m):
                Q[k] *= 0.5
        target = (np.int64(cluster[j]) * clusters + np.int64(cluster[i])) * (m * m)
        add_product(A, target, P, j * w * m, m, Q, 0, m, block_width, modes, modes)


@loop
def _restrict(P, cluster, r, out, block_width, one, modes):
    """Out += P^T r."""
    w, m = len(block_width), len(modes)
    for i in range(cluster.shape[0]):
        add_product(out, np.int64(cluster[i]) * m, r, i * w, 1, P, i * w * m, m, block_width, one, modes)


@loop
def _prolong(P, cluster, y, out, block_width, modes):
    """Out += P y."""
    w, m = len(block_width), len(modes)
    for i in range(cluster.shape[0]):
        add_matvec(out, i * w, P, i * w * m, y, np.int64(cluster[i]) * m, block_width, modes)


# ----------------------------------------------------------------------------------------------------------- Public

_ONE, _MODES = width(1), width(7)


class CoarseSpace:
    """Clusters of the cameras of one layout, and how they move; ``kept_class`` is that of the cameras."""

    def __init__(self, layout: Layout, kept_class: int, remote: RemoteBlocks | None = None) -> None:
        self._layout, self.kept_class, self._remote = layout, kept_class, remote
        self._kept = layout.kept[kept_class]
        rows, columns = layout.blocks[kept_class, kept_class]
        if remote is not None:
            rows, columns = map(np.concatenate, zip((rows, columns), remote.pairs(kept_class), strict=True))
        self._cluster = _clusters(rows, columns, self._kept.count)
        self.count = int(self._cluster.max()) + 1
        self._state: FloatArray | None = None
        self._P = np.zeros(0)
        self._factor: FloatArray | None = None

    def follow(self, states: Mapping[str, FloatArray]) -> None:
        """Take notice of the states at which the next systems are formed."""
        self._state = states[self._kept.members[0].group]

    def factorize(self, S: FloatArray) -> None:
        """Form and factorise P^T S P, unless the cameras have hardly moved since it was done.

        Before :meth:`follow`, or where the factorisation fails, there is no correction.
        """
        if self._state is None:
            return
        P = self._motions(self._state)
        if self._factor is not None and np.abs(P - self._P).max() < SAME_MOTIONS * np.abs(P).max():
            return
        self._P = P
        rows, columns = self._layout.blocks[self.kept_class, self.kept_class]
        n = self.count
        A = coarse_products(S, rows, columns, self._cluster, self._P)
        if self._remote is not None:
            A += self._remote.coarse(self.kept_class, self._cluster, self._P)
        A = A.reshape(n, n, 7, 7).transpose(0, 2, 1, 3).reshape(7 * n, 7 * n)
        A = A + A.T
        diagonal = A.diagonal()
        A[np.diag_indices(7 * n)] += JITTER * diagonal + np.where(diagonal > 0.0, 0.0, 1.0)
        factor, info = potrf(A, lower=1, clean=0, overwrite_a=1)
        self._factor = factor if info == 0 else None

    def _motions(self, state: FloatArray) -> FloatArray:
        """Return P, flat: how each camera moves with its cluster."""
        member = self._kept.members[0]
        group = self._layout.problem.variables[member.group]
        P = np.zeros((self._kept.count, self._kept.width, 7))
        P[:, : member.dof] = gauge_directions(group.manifold, state).transpose(1, 2, 0)
        free = group.free_coordinates()
        if free is not None:
            P[:, : member.dof] *= free[:, :, None]
        return P.reshape(-1)

    def correct(self, r: FloatArray, z: FloatArray) -> None:
        """Add the coarse part of the preconditioned residual ``r`` to ``z``."""
        if self._factor is None:
            return
        block_width = width(self._kept.width)
        y = np.zeros(7 * self.count)
        _restrict(self._P, self._cluster, r, y, block_width, _ONE, _MODES)
        y, _ = potrs(self._factor, y, lower=1)
        _prolong(self._P, self._cluster, y, z, block_width, _MODES)


def coarse_products(S: FloatArray, rows: IntArray, columns: IntArray, cluster: IntArray, P: FloatArray) -> FloatArray:
    """Return half of P^T S P for upper blocks S (n, w, w), flat, by pairs of clusters; with its transpose the whole."""
    w, clusters = S.shape[-1], int(cluster.max()) + 1
    A, Q = np.zeros(clusters * clusters * 49), np.empty(w * 7)
    _coarse_matrix(S.reshape(-1), rows, columns, cluster, P, A, Q, width(w), _MODES)
    return A


def coarse_space(layout: Layout, remote: RemoteBlocks | None = None) -> CoarseSpace | None:
    """Return the coarse space of the largest class of cameras; None where there are too few."""
    variables = layout.problem.variables
    cameras = [
        (kept.count, c)
        for c, kept in enumerate(layout.kept)
        if variables[kept.members[0].group].manifold.kind == "pose" and kept.members[0].block_of is None
    ]
    if not cameras or max(cameras)[0] < MIN_CLUSTERS * CLUSTER_SIZE:
        return None
    return CoarseSpace(layout, max(cameras)[1], remote)


def _clusters(rows: IntArray, columns: IntArray, count: int) -> IntArray:
    """Cluster of each block."""
    ends = np.concatenate([rows, columns])
    order = argsort_by(((ends, count),), len(ends))
    neighbor = np.concatenate([columns, rows])[order]
    pointer = pointers_of(np.bincount(ends, minlength=count))
    cluster = np.full(count, -1, np.int32)
    _grow(pointer, neighbor, max(CLUSTER_SIZE, -(-count // MAX_CLUSTERS)), cluster)
    return cluster
