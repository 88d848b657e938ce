# SPDX-License-Identifier: BSD-3-Clause
"""Arrays as the page of the viewer expects them."""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.viz.colours import Colours
from groma.viz.viewer.content import REACH


def by_end(colours: Colours) -> Colours:
    """Return colours (L, 3) for both ends of segments, (L, 2, 3).

    The page takes the colours of segment ends, unlike all others, as linear intensities.
    """
    share = np.asarray(colours, float) / 255.0
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.repeat(np.round(255.0 * light).astype(np.uint8)[:, None], 2, axis=1)


def point_size(count: int) -> float:
    """Return the initial point size, smaller for more points."""
    return float(np.clip(np.round(2.0 * (4.0 + 2e4 / max(count, 1))) / 2.0, 4.0, 12.0))


def camera_scale(centers: FloatArray) -> float:
    """Return the size of drawn cameras at which neighbours do not overlap, within limits."""
    if len(centers) < 2:
        return 0.08 * REACH
    from scipy.spatial import KDTree

    gap = float(np.median(KDTree(centers).query(centers, k=2)[0][:, 1]))
    return float(np.clip(0.45 * gap, 0.02 * REACH, 0.12 * REACH))
