# SPDX-License-Identifier: BSD-3-Clause
"""Reprojection residuals of a problem made from a scene, by kind of landmark."""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.adjustment.assemble import Assembly
from groma.problem.residuals import Residuals


def squared_residuals_px(
    assembly: Assembly, weighted: bool = False, residuals: Residuals | None = None
) -> dict[str, FloatArray]:
    """Return the squared norm of every reprojection residual by kind of landmark.

    A point has one residual of two coordinates, a segment one of the distances of its two ends.

    Parameters
    ----------
    assembly : Assembly
        A problem made from a scene, at any state.
    weighted : bool
        In standard deviations instead of pixels; of segments then at the places where they were measured.
    residuals : Residuals, optional
        Those of the problem, where they are needed elsewhere too.

    Returns
    -------
    dict
        For ``points`` and ``lines``, if there are: (N,) float64, pixels squared, or variances.
    """
    parts: dict[str, list[FloatArray]] = {}
    problem, residuals = assembly.problem, residuals or Residuals(assembly.problem)
    for group, factor in zip(assembly.groups, problem.factors, strict=True):
        if not group.observes or len(factor) == 0:
            continue
        residual = residuals.of(factor)
        unit = np.asarray(factor.sqrt_information if weighted else _or_1(group.pixels_of_residual))
        if unit.ndim == 3:
            residual, unit = np.einsum("nij,nj->ni", unit, residual), np.ones(1)
        if group.observes == "lines" and not weighted:
            residual = at_ends(residual, assembly.reach)
        parts.setdefault(group.observes, []).append(squared_length(residual) * unit**2)
    return {kind: np.concatenate(squares) for kind, squares in parts.items()}


def squared_length(residual: FloatArray) -> FloatArray:
    """Return the squared norms (N,) of the first two coordinates of residuals; of a stereo pair the left image."""
    x, y = residual[:, 0], residual[:, 1]
    return x * x + y * y


#: Unknowns of a landmark by kind.
_UNKNOWNS = {"points": 3, "lines": 4}


def redundancy_of(assembly: Assembly) -> dict[str, FloatArray]:
    """Return by kind, and in the order of :func:`squared_residuals_px`, what share of the noise is left in a residual.

    n observations of two coordinates each leave :math:`1 - d / 2n` of their variance when the d unknowns of their
    landmark are fitted to them; the cameras, which many observations determine, take up little.
    """
    groups = [(g.observes, f) for g, f in zip(assembly.groups, assembly.problem.factors, strict=True) if g.observes]
    rows: dict[str, list[IntArray]] = {}
    for kind, factor in groups:
        if len(factor):
            rows.setdefault(kind, []).extend(ref.index for _, ref in factor.references() if ref.group == kind)
    shares = {}
    for kind, parts in rows.items():
        index = np.concatenate(parts)
        fitted = 0.0 if assembly.problem.variables[kind].is_constant else _UNKNOWNS[kind] / 2.0
        shares[kind] = np.maximum(1.0 - fitted / np.bincount(index)[index], 0.0)
    return shares


def _or_1(pixels: FloatArray | None) -> FloatArray:
    return np.ones(1) if pixels is None else pixels


def at_ends(residual: FloatArray, reach: float) -> FloatArray:
    """Distances (N, 2) of a segment's ends from distances at two places, so far from its middle in half lengths."""
    middle, turn = 0.5 * (residual[:, 0] + residual[:, 1]), 0.5 * (residual[:, 1] - residual[:, 0]) / reach
    return np.stack([middle - turn, middle + turn], axis=1)
