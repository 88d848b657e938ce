# SPDX-License-Identifier: BSD-3-Clause
r"""From one chart to another: states, derivatives, covariances.

Two charts of one object hold the same ambient numbers up to a scale, :math:`a_2 = s\,a_1`. An increment
:math:`\delta_1` of the first and :math:`\delta_2` of the second describe the same motion if the ambient numbers move
alike *modulo scale*,

.. math:: B_2\,\delta_2 = s\,B_1\,\delta_1 + \kappa\,a_2 ,

for some number :math:`\kappa`: a change of :math:`(m, d)` or :math:`(n, w)` along itself moves nothing. With the
projection :math:`P = I - a_2 a_2^\top / \lVert a_2\rVert^2` the number drops out, and since
:math:`(P B_2)^{+} P = (P B_2)^{+}`,

.. math:: J = \frac{\partial \delta_2}{\partial \delta_1} = s\,(P B_2)^{+} B_1, \qquad
          \Sigma_2 = J\,\Sigma_1\,J^\top .

Both sides lie in the same tangent space, so the pseudo-inverse is exact wherever the second chart is regular, and rows
and columns may be scaled freely for the sake of the digits. Where the second chart is singular (an orthonormal line
through the origin), the motions that it cannot make are dropped; a covariance then lacks them, too.
"""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.errors import InputError, ShapeError
from groma.geometry.manifold import Manifold


def convert(state: FloatArray, source: Manifold, target: Manifold) -> FloatArray:
    """State in another chart of the same kind.

    Parameters
    ----------
    state : (N, source.state_size) float64
        Lines or planes in the chart ``source``.
    source, target : Manifold
        Charts of the same kind, ``line`` or ``plane``.

    Returns
    -------
    (N, target.state_size) float64

    Raises
    ------
    InputError
        If the charts are of different kinds, or the target cannot hold an object.
    """
    _check(source, target)
    return target.from_ambient(source.ambient(state))


def conversion_jacobian(state: FloatArray, source: Manifold, target: Manifold) -> FloatArray:
    r"""Derivative of the increments in ``target`` with respect to those in ``source``.

    .. math:: J = \frac{\partial\,\delta_{target}}{\partial\,\delta_{source}}
                = s\,(P B_{target})^{+} B_{source}

    Parameters
    ----------
    state : (N, source.state_size) float64
        Lines or planes in the chart ``source``.
    source, target : Manifold
        Charts of the same kind, ``line`` or ``plane``.

    Returns
    -------
    (N, dof, dof) float64
        At ``state`` and ``convert(state, source, target)``.

    Raises
    ------
    InputError
        If the charts are of different kinds, or the target cannot hold an object.

    Notes
    -----
    The increments in ``target`` start from ``convert(state, source, target)``, whose axes are those of the target's own
    rule. A closest point has no orientation: on the way back the plane may have the other sign, and other axes.

    J has full rank where both charts are regular. Where ``target`` is singular, its rows are those of least norm;
    where ``source`` is singular, J has the rank of the source.
    """
    other = convert(state, source, target)
    first, second = source.ambient(state), target.ambient(other)
    basis_first, basis_second = source.basis(state), target.basis(other)
    assert basis_first is not None and basis_second is not None  # charts of lines and planes are not the identity
    # Rows: the unit of length is the distance of the object where that is large, so that far objects keep their digits.
    lengths = _row_lengths(second, source.kind)
    first, second = first / lengths, second / lengths
    scale = np.sum(first * second, axis=1) / np.sum(first * first, axis=1)
    unit = second / np.linalg.norm(second, axis=1, keepdims=True)
    right = basis_first / lengths[:, :, None] * scale[:, None, None]
    left = basis_second / lengths[:, :, None]
    left = left - unit[:, :, None] * (unit[:, None, :] @ left)
    # Columns: of equal length, so that only a true loss of rank is cut off.
    norms = np.linalg.norm(left, axis=1)
    norms = np.where(norms > 1e-14 * norms.max(axis=1, keepdims=True, initial=0.0), norms, np.inf)[:, :, None]
    return np.linalg.pinv(left / np.swapaxes(norms, 1, 2)) @ right / norms


def convert_covariance(covariance: FloatArray, state: FloatArray, source: Manifold, target: Manifold) -> FloatArray:
    r"""Covariance of the increments in another chart, :math:`J \Sigma J^\top`.

    Parameters
    ----------
    covariance : (N, dof, dof) float64
        Of the increments in ``source``.
    state : (N, source.state_size) float64
        Lines or planes in the chart ``source``.
    source, target : Manifold
        Charts of the same kind, ``line`` or ``plane``.

    Returns
    -------
    (N, dof, dof) float64
        Of the increments in ``target`` at ``convert(state, source, target)``.

    Raises
    ------
    InputError
        If the charts are of different kinds, or the target cannot hold an object.
    ShapeError
        If there is not one covariance for each state.
    """
    covariance = np.asarray(covariance, dtype=np.float64)
    jacobian = conversion_jacobian(state, source, target)
    if covariance.shape != jacobian.shape:
        raise ShapeError(
            f"covariance must have shape {jacobian.shape}, one matrix for each state; got {covariance.shape}."
        )
    return jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)


def _check(source: Manifold, target: Manifold) -> None:
    for chart in (source, target):
        if chart.kind not in ("line", "plane"):
            raise InputError(
                f"Conversions exist between charts of lines and between charts of planes; got {chart!r}, a chart of "
                f"kind {chart.kind!r}. Take both charts from LINE_CHARTS or from PLANE_CHARTS."
            )
    if source.kind != target.kind:
        raise InputError(
            f"Both charts must be of the same kind; got {source!r} ({source.kind}) and {target!r} ({target.kind}). "
            "Take both from LINE_CHARTS or from PLANE_CHARTS."
        )


def _row_lengths(ambient: FloatArray, kind: str) -> FloatArray:
    """Divisors (N, 6) or (N, 4) that carry the objects to at most one unit from the origin."""
    lengths = np.ones_like(ambient)
    near, far = (slice(3, 6), slice(0, 3)) if kind == "line" else (slice(0, 3), slice(3, 4))
    direction = np.linalg.norm(ambient[:, near], axis=1, keepdims=True)
    distance = np.linalg.norm(ambient[:, far], axis=1, keepdims=True) / np.where(direction > 0.0, direction, np.inf)
    lengths[:, far] = np.maximum(distance, 1.0)
    return lengths
