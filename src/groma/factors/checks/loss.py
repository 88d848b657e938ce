# SPDX-License-Identifier: BSD-3-Clause
"""The conformance check of losses, public as :func:`groma.testing.check_loss`."""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.errors import require
from groma.factors.losses import Loss

#: Squared norms at which derivatives are compared, in squared standard deviations.
_NORMS = np.array([1e-6, 0.01, 0.3, 0.87, 1.93, 5.3, 17.7, 311.0, 1e6])


def check_loss(loss: Loss, tolerance: float = 1e-6) -> None:
    r"""Check that a loss keeps the promises of :mod:`groma.factors.losses`.

    1. :math:`\rho(0) = 0` and :math:`\rho'(0) = 1`.
    2. :math:`\rho'` and :math:`\rho''` equal central differences, except next to a kink.
    3. :math:`\rho` never falls, and never grows faster than least squares: :math:`0 \le \rho' \le 1`.
    4. Everything is finite up to a million squared standard deviations.

    Parameters
    ----------
    loss : Loss
        The loss, with usual parameters.
    tolerance : float
        Largest deviation of a derivative, relative to the largest weight.

    Raises
    ------
    AssertionError
        If a promise is broken.
    """
    value, weight, second = loss.evaluate(np.zeros(1))
    require(value[0] == 0.0, repr(loss), f"rho(0) must be 0; got {value[0]}")
    require(abs(weight[0] - 1.0) <= 1e-12, repr(loss), f"rho'(0) must be 1; got {weight[0]}")
    value, weight, second = loss.evaluate(_NORMS)
    require(bool(np.isfinite([value, weight, second]).all()), repr(loss), f"a number is not finite at {_NORMS}")
    require(bool((np.diff(value) >= 0.0).all()), repr(loss), f"rho falls: {value} at {_NORMS}")
    bounded = bool(((weight >= 0.0) & (weight <= 1.0 + 1e-12)).all())
    require(bounded, repr(loss), f"rho' must lie between 0 and 1; got {weight} at {_NORMS}")
    _compare(loss, "rho'", 0, weight, tolerance, np.ones_like(_NORMS))
    _compare(loss, "rho''", 1, second, tolerance, _NORMS)


def _compare(loss: Loss, name: str, order: int, derivative: FloatArray, tolerance: float, scale: FloatArray) -> None:
    step = 1e-5 * _NORMS
    plus, minus = loss.evaluate(_NORMS + step)[order], loss.evaluate(_NORMS - step)[order]
    deviation = np.abs((plus - minus) / (2.0 * step) - derivative) * scale
    worst = int(np.argmax(np.where(np.isnan(deviation), np.inf, deviation)))
    require(
        bool(deviation[worst] <= tolerance),
        repr(loss),
        f"{name} differs from differences by {deviation[worst]:.2e} (allowed {tolerance:.0e}) at {_NORMS[worst]}",
    )
