# SPDX-License-Identifier: BSD-3-Clause
r"""Poses of a graph from two linear systems, without initial poses.

With the measured motions :math:`(Z_{ij}, z_{ij})` first the rotations, as matrices without constraints,

.. math:: \min_R \sum_{ij} \kappa_{ij} \lVert R_i Z_{ij} - R_j \rVert_F^2 ,

each then replaced by the nearest rotation, and with these the places,

.. math:: \min_t \sum_{ij} \tau_{ij} \lVert t_i + R_i z_{ij} - t_j \rVert^2 ,

where :math:`\kappa` and :math:`\tau` are the means of the information about the three axes and along them. Unlike
motions put one after the other all motions count, so that errors do not add up along a way.

Source: L. Carlone, R. Tron, K. Daniilidis, F. Dellaert, *Initialization techniques for 3D SLAM: a survey on rotation
estimation and its use in pose graph optimization*, ICRA 2015, section III-A (chordal relaxation).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.geometry import quaternion, so3
from groma.scene.pose_graph import PoseGraph

if TYPE_CHECKING:
    from scipy.sparse import csc_array


def linear_start(graph: PoseGraph, held: BoolArray) -> PoseGraph | None:
    """Return the graph with the poses that are not held as its motions have them, all together; None if they do not.

    Parameters
    ----------
    graph : PoseGraph
        The motions, and the poses that are held.
    held : (N,) bool
        At least one pose of each connected part.

    Degenerate: poses that only motions without information tie to the others; there is no start then.
    """
    poses, motions = graph.poses.world_from_body, graph.motions
    rotation, place = (motions.information[:, part, part] for part in (slice(3, 6), slice(0, 3)))
    turns = quaternion.to_matrix(motions.first_from_second[:, :4])
    free = ~held
    # rows of rotations are columns of the unknowns: transposed, R_i Z - R_j is Z^T R_i^T - R_j^T
    transposed = quaternion.to_matrix(poses[:, :4]).transpose(0, 2, 1)
    weight = np.sqrt(np.trace(rotation, axis1=1, axis2=2))
    nothing = np.zeros((3 * len(motions), 3))
    ends = motions.first_idx, motions.second_idx
    blocks = turns.transpose(0, 2, 1) * weight[:, None, None], -np.eye(3) * weight[:, None, None]
    rows = _rows(ends, blocks, len(poses))
    found = _solved(rows, nothing, transposed.reshape(-1, 3), np.repeat(free, 3))
    transposed = _nearest_rotations(found.reshape(-1, 3, 3))
    weight = np.sqrt(np.trace(place, axis1=1, axis2=2))
    ones = weight[:, None, None]
    along = np.einsum("nji,nj->ni", transposed[motions.first_idx], motions.first_from_second[:, 4:])
    places = _solved(_rows(ends, (-ones, ones), len(poses)), weight[:, None] * along, poses[:, 4:], free)
    new = np.hstack([quaternion.from_matrix(transposed.transpose(0, 2, 1)), places])
    if not np.isfinite(new).all():
        return None
    return graph.replace(poses=graph.poses.replace(world_from_body=np.where(free[:, None], new, poses)))


def _rows(ends: tuple[IntArray, IntArray], blocks: tuple[FloatArray, FloatArray], count: int) -> csc_array:
    """Return the matrix with one row of blocks (E, n, n) for each motion, at the columns of its two poses."""
    from scipy.sparse import coo_array

    size = blocks[0].shape[1]
    inside = np.arange(size)
    row = np.arange(len(ends[0]))[:, None, None] * size + inside[:, None] + np.zeros_like(inside)
    columns = [end[:, None, None] * size + inside + np.zeros_like(inside)[:, None] for end in ends]
    values = np.concatenate([np.broadcast_to(block, row.shape).ravel() for block in blocks])
    places = np.tile(row.ravel(), 2), np.concatenate([column.ravel() for column in columns])
    return coo_array((values, places), shape=(row.size // size, count * size)).tocsc()


def _solved(matrix: csc_array, wanted: FloatArray, known: FloatArray, free: BoolArray) -> FloatArray:
    """Return the least-squares solution (N, 3) of a linear system with some unknowns held."""
    from scipy.sparse.linalg import splu

    result = known.copy()
    if not free.any():
        return result
    part = matrix[:, free]
    target = part.T @ (wanted - matrix[:, ~free] @ known[~free])
    try:
        factor = splu(
            (part.T @ part).tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        result[free] = factor.solve(np.asarray(target))
    except RuntimeError:  # singular
        result[free] = np.nan
    return result


def _nearest_rotations(matrices: FloatArray) -> FloatArray:
    """Return the rotations (N, 3, 3) nearest to matrices; NaN where these are not finite."""
    finite: BoolArray = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    rotations = so3.nearest(np.where(finite[:, None, None], matrices, np.eye(3)))
    rotations[~finite] = np.nan
    return rotations
