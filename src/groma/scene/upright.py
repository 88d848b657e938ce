# SPDX-License-Identifier: BSD-3-Clause
"""Which way is up, as far as photographs tell."""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray


def upward(down: FloatArray) -> FloatArray:
    """Return the direction (3,) that is up for cameras whose y axes (N, 3) point down; z if that is not clear."""
    up = -down.sum(axis=0)
    if np.linalg.norm(up) < 0.3 * max(len(down), 1):
        return np.array([0.0, 0.0, 1.0])
    return up / np.linalg.norm(up)
