# SPDX-License-Identifier: BSD-3-Clause
"""The noise of the observations of a scene, from their residuals."""

from __future__ import annotations

from typing import Literal

import numpy as np

from groma.pipelines._assemble import AssemblyOptions, assemble
from groma.pipelines.adjust import squared_residuals_px
from groma.scene import Scene

#: Residuals smaller than this are not believed, pixels: synthetic scenes may have none.
MIN_SIGMA_PX = 0.02
#: Fewer observations tell nothing; this is assumed then, pixels.
_FEWEST, _UNKNOWN_PX = 10, 1.0


def noise_px(scene: Scene, kind: Literal["points", "lines"]) -> float:
    """Return the standard deviation of the usual coordinate of one kind of landmark, robustly, pixels.

    The median of the squared norm of two Gaussian coordinates is 1.386 variances; fitted landmarks take their share.
    The observations' own standard deviations are relative to what is returned.
    """
    assembly = assemble(scene, AssemblyOptions(points=kind == "points", lines=kind == "lines", planes=False))
    squares = squared_residuals_px(assembly, weighted=True).get(kind)
    if squares is None or len(squares) < _FEWEST:
        return _UNKNOWN_PX
    unknowns = 3 * scene.num_points if kind == "points" else 4 * scene.num_lines
    share = 1.0 - min(unknowns / (2 * len(squares)), 0.8)
    return max(float(np.sqrt(np.median(squares) / 1.386 / share)), MIN_SIGMA_PX)


__all__ = ["noise_px"]
