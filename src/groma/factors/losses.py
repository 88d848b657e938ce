# SPDX-License-Identifier: BSD-3-Clause
r"""Robust losses.

A loss :math:`\rho` maps the squared whitened norm :math:`s = \lVert \Sigma^{-1/2} r \rVert^2` of one factor to its
share of the cost :math:`\tfrac12 \sum \rho(s)`. All losses are normalised so that

.. math:: \rho(0) = 0, \qquad \rho'(0) = 1, \qquad \rho(s) = c^2\, \rho_0(s / c^2),

thus they agree with least squares near zero, :math:`\rho'(s)` is the weight of a factor in reweighted least squares,
and the scale :math:`c` is the residual norm, in standard deviations, at which they begin to differ.

=============  ===================================================================  ==============================
name           :math:`\rho(s)` with :math:`z = s/c^2`                               weight :math:`\rho'(s)`
=============  ===================================================================  ==============================
trivial        s                                                                    1
huber          s for z <= 1, else :math:`c^2 (2\sqrt z - 1)`                        1, else :math:`1/\sqrt z`
soft_l1        :math:`2c^2(\sqrt{1+z} - 1)`                                         :math:`(1+z)^{-1/2}`
cauchy         :math:`c^2 \log(1+z)`                                                :math:`1/(1+z)`
tukey          :math:`\tfrac{c^2}{3}(1-(1-z)^3)` for z <= 1, else :math:`c^2/3`     :math:`(1-z)^2`, else 0
geman_mcclure  :math:`c^2 z/(1+z)`                                                  :math:`(1+z)^{-2}`
barron         :math:`2c^2 \tfrac{b}{\alpha}((z/b+1)^{\alpha/2} - 1)`               :math:`(z/b+1)^{\alpha/2-1}`
truncated      min(s, c²)                                                           1, else 0
=============  ===================================================================  ==============================

with :math:`b = |\alpha - 2|` (Barron, *A general and adaptive robust loss function*, 2019, eq. (8), times two because
the cost above has the factor one half). It runs through the others: :math:`\alpha = 2` is trivial, 1 is soft_l1(c),
0 is cauchy(:math:`\sqrt2 c`), -2 is geman_mcclure(2c).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import FloatArray
from groma.errors import InputError

TRIVIAL, HUBER, SOFT_L1, CAUCHY, TUKEY, GEMAN_MCCLURE, BARRON, TRUNCATED = range(8)
_SMALL = 1e-8  # below this, Barron's alpha or 2 - alpha counts as zero


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def loss_derivatives(code, a, b, s):
    """Return (rho, rho', rho'') of the loss ``code`` with parameters (a, b) at the squared norm ``s``."""
    if code == TRIVIAL:
        return s, 1.0, 0.0
    c2 = a * a
    z = s / c2
    if code == HUBER:
        if z <= 1.0:
            return s, 1.0, 0.0
        root = math.sqrt(z)
        return c2 * (2.0 * root - 1.0), 1.0 / root, -0.5 / (c2 * z * root)
    if code == SOFT_L1:
        root = math.sqrt(1.0 + z)
        return 2.0 * s / (root + 1.0), 1.0 / root, -0.5 / (c2 * (1.0 + z) * root)
    if code == CAUCHY:
        weight = 1.0 / (1.0 + z)
        return c2 * math.log1p(z), weight, -weight * weight / c2
    if code == TUKEY:
        if z <= 1.0:
            u = 1.0 - z
            return s * (1.0 + u + u * u) / 3.0, u * u, -2.0 * u / c2
        return c2 / 3.0, 0.0, 0.0
    if code == GEMAN_MCCLURE:
        weight = 1.0 / (1.0 + z)
        return s * weight, weight * weight, -2.0 * weight * weight * weight / c2
    if code == BARRON:
        d = 2.0 - b
        if d < _SMALL:
            return s, 1.0, 0.0
        if math.isinf(b):
            weight = math.exp(-0.5 * z)
            return -2.0 * c2 * math.expm1(-0.5 * z), weight, -0.5 * weight / c2
        log_p = math.log1p(z / d)
        weight = math.exp((0.5 * b - 1.0) * log_p)
        second = -0.5 / c2 * math.exp((0.5 * b - 2.0) * log_p)
        if abs(b) < _SMALL:
            return c2 * d * log_p, weight, second
        return 2.0 * c2 * d / b * math.expm1(0.5 * b * log_p), weight, second
    if z <= 1.0:  # truncated
        return s, 1.0, 0.0
    return c2, 0.0, 0.0


@kernel
def loss_value(code, a, b, s):
    """Return rho of the loss ``code`` with parameters (a, b) at the squared norm ``s``."""
    return loss_derivatives(code, a, b, s)[0]


@loop
def _evaluate_all(code, a, b, s, out):
    for i in range(s.shape[0]):
        out[0, i], out[1, i], out[2, i] = loss_derivatives(code, a, b, s[i])


# ------------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True)
class Loss:
    """A robust loss rho(s) on the squared whitened norm s; use one of the subclasses, or :func:`loss` by name."""

    #: Number by which kernels know the loss.
    code: ClassVar[int] = TRIVIAL
    #: Name as options spell it.
    name: ClassVar[str] = ""

    def __post_init__(self) -> None:
        scale = getattr(self, "scale", 1.0)
        if not (math.isfinite(scale) and scale > 0.0):
            raise InputError(
                f"The scale of the loss {self.name!r} must be a positive number (standard deviations); got {scale}. "
                "Use the loss 'none' for plain least squares."
            )

    @property
    def parameters(self) -> FloatArray:
        """(2,) float64, the scale c and the shape alpha, as :func:`loss_derivatives` takes them."""
        return np.array([getattr(self, "scale", 1.0), getattr(self, "alpha", 0.0)])

    def evaluate(self, squared_norm: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return rho, rho' and rho'' at the squared whitened norms ``squared_norm`` (...)."""
        s = np.asarray(squared_norm, dtype=np.float64)
        out = np.empty((3, s.size))
        a, b = self.parameters
        _evaluate_all(self.code, a, b, np.ascontiguousarray(s).reshape(-1), out)
        return out[0].reshape(s.shape), out[1].reshape(s.shape), out[2].reshape(s.shape)


@dataclass(frozen=True)
class Trivial(Loss):
    """Plain least squares, rho(s) = s."""

    code: ClassVar[int] = TRIVIAL
    name: ClassVar[str] = "trivial"


@dataclass(frozen=True)
class Huber(Loss):
    """Quadratic up to ``scale``, linear beyond; convex."""

    code: ClassVar[int] = HUBER
    name: ClassVar[str] = "huber"
    #: Whitened norm at which the growth turns linear.
    scale: float = 1.0


@dataclass(frozen=True)
class SoftL1(Loss):
    """Smooth form of Huber; convex."""

    code: ClassVar[int] = SOFT_L1
    name: ClassVar[str] = "soft_l1"
    #: Whitened norm around which the growth turns linear.
    scale: float = 1.0


@dataclass(frozen=True)
class Cauchy(Loss):
    """Logarithmic growth; the usual choice for matches, with a scale near the noise level."""

    code: ClassVar[int] = CAUCHY
    name: ClassVar[str] = "cauchy"
    #: Whitened norm at which a factor has half its weight.
    scale: float = 1.0


@dataclass(frozen=True)
class Tukey(Loss):
    """Constant beyond ``scale``: outliers have no influence at all, so a good start is needed."""

    code: ClassVar[int] = TUKEY
    name: ClassVar[str] = "tukey"
    #: Whitened norm beyond which a factor has no weight.
    scale: float = 1.0


@dataclass(frozen=True)
class GemanMcClure(Loss):
    """Bounded and smooth."""

    code: ClassVar[int] = GEMAN_MCCLURE
    name: ClassVar[str] = "geman_mcclure"
    #: Whitened norm at which a factor has a quarter of its weight.
    scale: float = 1.0


@dataclass(frozen=True)
class Barron(Loss):
    """The general family: ``alpha`` 2 is least squares, 1 soft L1, 0 Cauchy, -2 Geman-McClure, -inf Welsch."""

    code: ClassVar[int] = BARRON
    name: ClassVar[str] = "barron"
    #: Shape, at most 2.
    alpha: float = 1.0
    #: Whitened norm around which the loss leaves the parabola.
    scale: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.alpha <= 2.0:
            raise InputError(f"The shape alpha of the loss 'barron' must be at most 2; got {self.alpha}.")


@dataclass(frozen=True)
class Truncated(Loss):
    """Least squares cut off at ``scale``; not smooth there."""

    code: ClassVar[int] = TRUNCATED
    name: ClassVar[str] = "truncated"
    #: Whitened norm beyond which a factor has no weight.
    scale: float = 1.0


#: All losses by name.
LOSSES: dict[str, type[Loss]] = {
    cls.name: cls for cls in (Trivial, Huber, SoftL1, Cauchy, Tukey, GemanMcClure, Barron, Truncated)
}


def loss(name: str, scale: float = 1.0, *, alpha: float | None = None) -> Loss:
    """Make a loss by name.

    Parameters
    ----------
    name : str
        ``trivial`` (or ``none``), ``huber``, ``soft_l1``, ``cauchy``, ``tukey``, ``geman_mcclure``, ``barron`` or
        ``truncated``; a hyphen may stand for the underscore.
    scale : float
        Whitened residual norm at which the loss leaves the parabola; without effect on ``trivial``.
    alpha : float, optional
        Shape, at most 2, for ``barron`` only (1 if not given).

    Returns
    -------
    Loss

    Raises
    ------
    InputError
        If there is no such loss, or a parameter is out of range.
    """
    key = name.lower().replace("-", "_")
    key = "trivial" if key == "none" else key
    if key not in LOSSES:
        known = ["none", *sorted(set(LOSSES) - {"trivial"})]
        raise InputError(f"There is no loss named {name!r}; choose one of {', '.join(known)}.")
    if alpha is not None and key != "barron":
        raise InputError(f"Only the loss 'barron' has a shape alpha; got alpha={alpha} for {name!r}. Leave it out.")
    if key == "trivial":
        return Trivial()
    if key == "barron":
        return Barron(1.0 if alpha is None else float(alpha), float(scale))
    return LOSSES[key](float(scale))  # type: ignore[call-arg]


__all__ = [
    "LOSSES",
    "Barron",
    "Cauchy",
    "GemanMcClure",
    "Huber",
    "Loss",
    "SoftL1",
    "Trivial",
    "Truncated",
    "Tukey",
    "loss",
    "loss_derivatives",
    "loss_value",
]
