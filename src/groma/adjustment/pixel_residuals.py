# SPDX-License-Identifier: BSD-3-Clause
"""Reprojection residuals of a problem made from a scene, by kind of landmark."""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.adjustment.assemble import LINE_FACTORS, POINT_FACTORS, Assembly
from groma.problem.residuals import residuals_of


def squared_residuals_px(assembly: Assembly, weighted: bool = False) -> dict[str, FloatArray]:
    """Return the squared norm of every reprojection residual by kind of landmark.

    A point has one residual of two coordinates, a segment one of the distances of its two ends.

    Parameters
    ----------
    assembly : Assembly
        A problem made from a scene, at any state.
    weighted : bool
        In standard deviations instead of pixels; of segments then at the places where they were measured.

    Returns
    -------
    dict
        For ``points`` and ``lines``, if there are: (N,) float64, pixels squared, or variances.
    """
    parts: dict[str, list[FloatArray]] = {}
    problem = assembly.problem
    for number, factor in enumerate(problem.factors):
        kind = "points" if factor.type_name in POINT_FACTORS else "lines" if factor.type_name in LINE_FACTORS else None
        if kind is None or len(factor) == 0:
            continue
        residual = residuals_of(factor, problem.variables)
        if kind == "lines" and not weighted:
            residual = at_ends(residual, assembly.reach)
        unit = factor.sqrt_information if weighted else assembly.pixels_of_residual.get(number, 1.0)
        parts.setdefault(kind, []).append(np.einsum("ni,ni->n", residual, residual) * np.asarray(unit) ** 2)
    return {kind: np.concatenate(squares) for kind, squares in parts.items()}


def at_ends(residual: FloatArray, reach: float) -> FloatArray:
    """Distances (N, 2) of a segment's ends from distances at two places, so far from its middle in half lengths."""
    middle, turn = residual.mean(axis=1), 0.5 * (residual[:, 1] - residual[:, 0]) / reach
    return np.stack([middle - turn, middle + turn], axis=1)


__all__ = ["at_ends", "squared_residuals_px"]
