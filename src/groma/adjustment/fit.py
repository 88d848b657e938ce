# SPDX-License-Identifier: BSD-3-Clause
r"""How well observations fit: which of them are inliers, their rms, and the noise that they show.

The rms of all observations is an rms of outliers: under a robust loss it may grow while everything improves. What is
told instead is of inliers: observations that end no farther from their landmark than noise of the size that the
residuals show would put them. With the squared residuals :math:`r^2`, and the share :math:`\varrho` of the noise that
the fit leaves in them,

.. math:: \sigma^2 = \mathrm{median}(r^2 / \varrho) / 1.386, \qquad \text{limit}^2 = \sigma^2 \chi^2_2(0.997);

the median of the squared norm of two normal coordinates is 1.386 variances, and outliers hardly move it. The rms before
is that of the same observations.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from groma._typing import FloatArray
from groma.gates import NORMAL, chi_square_gate


def noise_of(squares: FloatArray, redundancy: FloatArray | float = 1.0) -> float:
    """Return the standard deviation of a coordinate that squared norms (N,) of pairs show; NaN where there are none."""
    counting = (squares > 0.0) & (np.asarray(redundancy) > 0.0)  # what cannot be evaluated is zero
    if not counting.any():
        return float("nan")
    share = np.broadcast_to(redundancy, squares.shape)[counting]
    return float(np.sqrt(np.median(squares[counting] / share) / chi_square_gate(0.5, 2)))


def inliers(
    before: Mapping[str, FloatArray], after: Mapping[str, FloatArray], redundancy: Mapping[str, FloatArray]
) -> dict[str, dict[str, Any]]:
    """Return the statistics of inliers by kind of landmark.

    Parameters
    ----------
    before, after : mapping
        Squared residuals (N,) of the same observations by kind, pixels squared.
    redundancy : mapping
        Share (N,) of the noise that the fit leaves in them, by kind.

    Returns
    -------
    dict
        For each kind ``limit_px``; and ``share`` and ``rmse_px``, each before and after. The share before is of the
        observations within the same limit, the rms before of the inliers after.
    """
    found = {}
    for kind, squares in after.items():
        limit = noise_of(squares, redundancy[kind]) ** 2 * chi_square_gate(NORMAL.outlier, 2)
        inside = (squares > 0.0) & (squares <= limit)
        if not inside.any():
            continue
        start = before[kind]
        found[kind] = {
            "limit_px": float(np.sqrt(limit)),
            "share": {"before": float(np.mean((start > 0.0) & (start <= limit))), "after": float(np.mean(inside))},
            "rmse_px": {
                "before": float(np.sqrt(np.mean(start[inside]))), "after": float(np.sqrt(np.mean(squares[inside]))),
            },
        }  # fmt: skip
    return found
