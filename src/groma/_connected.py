# SPDX-License-Identifier: BSD-3-Clause
"""Parts of a graph: what is connected with what."""

from __future__ import annotations

import numpy as np

from groma._typing import IntArray


def connected_parts(first: IntArray, second: IntArray, count: int) -> IntArray:
    """Return the part (count,) of ``count`` things that each is in, where pairs are tied; parts by their first thing.

    In a round every part is joined to the lowest of those it is tied to. ``scipy.sparse.csgraph`` takes as long, and
    a quarter of a second to import.
    """
    lowest = np.arange(count)
    while True:
        one, other = lowest[first], lowest[second]
        apart = one != other
        if not apart.any():
            return np.unique(lowest, return_inverse=True)[1]
        first, second, one, other = first[apart], second[apart], one[apart], other[apart]
        np.minimum.at(lowest, np.maximum(one, other), np.minimum(one, other))
        while (lowest != lowest[lowest]).any():
            lowest = lowest[lowest]
