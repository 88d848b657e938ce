# SPDX-License-Identifier: BSD-3-Clause
"""Which images hang together: through frames, landmarks that they share, and relations between landmarks."""

from __future__ import annotations

from dataclasses import fields
from itertools import combinations

import numpy as np

from groma._rows import connected_parts, pointers_of
from groma._typing import IntArray
from groma.scene.scene import Scene

#: What takes part. Cameras and rigs do not: two photographs by one camera need not see the same.
_NODES = ("images", "frames", "points", "lines", "planes", "directions")


def connected_images(scene: Scene) -> list[IntArray]:
    """Return the groups of images between which there is any connection, the largest first.

    Images that see nothing are groups of their own.
    """
    counts = [len(getattr(scene, name)) for name in _NODES]
    first = dict(zip(_NODES, pointers_of(counts).tolist(), strict=False))
    pairs = [np.zeros((0, 2), np.int64)]
    for item in fields(scene):
        table = getattr(scene, item.name)
        places: list[IntArray] = []
        if item.name in first:
            places.append(first[item.name] + np.arange(len(table)))
        for column in fields(table):
            refers = column.metadata["refers"]
            if not refers or any(name not in first for name in refers):
                continue
            values = getattr(table, column.name).reshape(-1, len(refers))
            own = [first[name] + values[:, place] for place, name in enumerate(refers)]
            if len(own) > 1:  # pairs, of any number
                pairs.append(np.column_stack(own))
            else:
                places += own
        pairs += [np.column_stack(two) for two in combinations(places, 2)]
    one, other = np.concatenate(pairs).T
    label = connected_parts(one, other, sum(counts))
    groups = [np.flatnonzero(label[: scene.num_images] == one) for one in np.unique(label[: scene.num_images])]
    return sorted(groups, key=len, reverse=True)
