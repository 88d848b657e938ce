# SPDX-License-Identifier: BSD-3-Clause
"""Join neighbouring pieces of one straight edge.

A detector that grows regions breaks an edge where a twig, a lamp post or noise crosses it. Two pieces belong together
when the second begins where the first ends, both run the same way (their dark sides agree) and their end points lie on
one line. Chains are joined whole; a chain that bends is left in pieces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._rows import connected_parts
from groma._trees import kd_tree
from groma._typing import FloatArray
from groma.features.segments import SEGMENTS
from groma.gates import gate


@dataclass(frozen=True)
class MergeGates:
    """Pieces of one edge."""

    min_piece: float = gate(8.0, "px", "shortest piece of a segment", "derived from what LSD finds in noise")
    gap: float = gate(8.0, "px", "from the end of one piece to the beginning of the next", "chosen on Strecha's scenes")
    angle: float = gate(0.04, "rad", "between two pieces", "chosen on Strecha's scenes")
    overlap: float = gate(2.0, "px", "by which the next piece may begin before the end", "chosen on Strecha's scenes")


#: The defaults.
MERGES = MergeGates()


def merge_collinear(ends: FloatArray, gates: MergeGates = MERGES) -> FloatArray:
    """Segments with collinear neighbours joined.

    Parameters
    ----------
    ends : (N, 4) float64
        Directed segments, pixels.
    gates : MergeGates
        What counts as one edge.

    Returns
    -------
    (M, 4) float64
        Pieces that stand alone, unchanged and in order, then the joined ones. M <= N.
    """
    ends = np.asarray(ends, dtype=np.float64)
    if len(ends) < 2:
        return ends.copy()
    start, end = ends[:, :2], ends[:, 2:]
    length = np.maximum(np.linalg.norm(end - start, axis=1), 1e-9)
    along = (end - start) / length[:, None]
    near = kd_tree(end).sparse_distance_matrix(kd_tree(start), gates.gap, output_type="coo_matrix")
    first, second = near.row.astype(np.intp), near.col.astype(np.intp)
    # The next piece must lie ahead, parallel, and on the line of the longer of the two.
    longer = np.where((length[first] >= length[second]), first, second)
    offset = start[second] - end[first]
    across = np.abs(offset[:, 0] * along[longer, 1] - offset[:, 1] * along[longer, 0])
    ahead = (offset * along[longer]).sum(axis=1)
    parallel = (along[first] * along[second]).sum(axis=1) > np.cos(gates.angle)
    joined = (first != second) & parallel & (across < SEGMENTS.edge) & (ahead > -gates.overlap)
    first, second = first[joined], second[joined]
    group = connected_parts(first, second, len(ends))
    size = np.bincount(group)
    count = len(size)

    # Line of each group: mean and principal direction of the end points, weighted by length.
    points, owner = ends.reshape(-1, 2), np.repeat(group, 2)
    weight = np.repeat(length, 2)
    total = np.bincount(owner, weight, count)
    mean = np.stack([np.bincount(owner, weight * points[:, k], count) for k in (0, 1)], axis=1) / total[:, None]
    centred = points - mean[owner]
    xx, xy, yy = (
        np.bincount(owner, weight * centred[:, i] * centred[:, j], count) for i, j in ((0, 0), (0, 1), (1, 1))
    )
    theta = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    axis = np.stack([np.cos(theta), np.sin(theta)], axis=1)
    heading = np.stack([np.bincount(group, (end - start)[:, k], count) for k in (0, 1)], axis=1)
    axis *= np.where((axis * heading).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    at = (centred * axis[owner]).sum(axis=1)
    off = np.abs(centred[:, 0] * axis[owner, 1] - centred[:, 1] * axis[owner, 0])
    low, high, worst = np.full(count, np.inf), np.full(count, -np.inf), np.zeros(count)
    np.minimum.at(low, owner, at)
    np.maximum.at(high, owner, at)
    np.maximum.at(worst, owner, off)

    straight = (size > 1) & (worst <= SEGMENTS.edge)
    whole = np.hstack([mean + low[:, None] * axis, mean + high[:, None] * axis])[straight]
    return np.vstack([ends[~straight[group]], whole])
