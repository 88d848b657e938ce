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

A loss is a kernel and a frozen dataclass whose fields are the kernel's parameters, made known by :func:`register_loss`,
here or in another package. Compiled loops take its :attr:`Loss.tag`, a tuple of ``None`` whose length selects the
kernel while they are compiled, as with camera models (:mod:`groma.cameras.dispatch`): no branch is left in them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Any, ClassVar, TypeVar

import numpy as np
from numba.extending import overload

from groma._kernels.digest import ByLength
from groma._numba import exact_kernel, kernel, loop
from groma._typing import FloatArray
from groma.errors import InputError, check_kind, did_you_mean

_SMALL = 1e-8  # below this, Barron's alpha or 2 - alpha counts as zero

#: Takes the parameters of a loss, a tuple of floats, and a squared norm; returns (rho, rho', rho'').
LossKernel = Callable[[tuple[float, ...], float], tuple[float, float, float]]


# ------------------------------------------------------------------------------------------------------------ Kernels
#: Kernels by length of the tag; filled by :func:`register_loss`. Compiled code on disk depends on the kernels that it
#: was compiled with, so a number may mean another loss in another process.
_DERIVATIVES: ByLength[LossKernel] = ByLength()


def loss_derivatives(loss_tag, parameters, s):
    """Return (rho, rho', rho'') of the loss with ``loss_tag`` at the squared norm ``s``."""
    return _DERIVATIVES[len(loss_tag)](parameters, s)


@overload(loss_derivatives)
def _loss_derivatives(loss_tag, parameters, s):
    derivatives = _DERIVATIVES[loss_tag.count]
    return lambda loss_tag, parameters, s: derivatives(parameters, s)


@kernel
def loss_value(loss_tag, parameters, s):
    """Return rho of the loss with ``loss_tag`` at the squared norm ``s``."""
    return loss_derivatives(loss_tag, parameters, s)[0]


@loop
def _evaluate_all(loss_tag, parameters, s, out):
    for i in range(s.shape[0]):
        out[0, i], out[1, i], out[2, i] = loss_derivatives(loss_tag, parameters, s[i])


@exact_kernel
def _over(s, scale):
    """Return s / scale², rounded alike wherever it is inlined."""
    return s * (1.0 / (scale * scale))


@kernel
def _trivial(parameters, s):
    return s, 1.0, 0.0


@kernel
def _huber(parameters, s):
    c2 = parameters[0] * parameters[0]
    z = _over(s, parameters[0])
    if z <= 1.0:
        return s, 1.0, 0.0
    root = math.sqrt(z)
    return c2 * (2.0 * root - 1.0), 1.0 / root, -0.5 / (c2 * z * root)


@kernel
def _soft_l1(parameters, s):
    c2 = parameters[0] * parameters[0]
    z = _over(s, parameters[0])
    root = math.sqrt(1.0 + z)
    return 2.0 * s / (root + 1.0), 1.0 / root, -0.5 / (c2 * (1.0 + z) * root)


@kernel
def _cauchy(parameters, s):
    c2 = parameters[0] * parameters[0]
    z = _over(s, parameters[0])
    weight = 1.0 / (1.0 + z)
    return c2 * math.log1p(z), weight, -weight * weight / c2


@kernel
def _tukey(parameters, s):
    c2 = parameters[0] * parameters[0]
    z = _over(s, parameters[0])
    if z <= 1.0:
        u = 1.0 - z
        return s * (1.0 + u + u * u) / 3.0, u * u, -2.0 * u / c2
    return c2 / 3.0, 0.0, 0.0


@kernel
def _geman_mcclure(parameters, s):
    c2 = parameters[0] * parameters[0]
    z = _over(s, parameters[0])
    weight = 1.0 / (1.0 + z)
    return s * weight, weight * weight, -2.0 * weight * weight * weight / c2


@kernel
def _barron(parameters, s):
    b, c2 = parameters[0], parameters[1] * parameters[1]
    z = _over(s, parameters[1])
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


@kernel
def _truncated(parameters, s):
    c2 = parameters[0] * parameters[0]
    if _over(s, parameters[0]) <= 1.0:
        return s, 1.0, 0.0
    return c2, 0.0, 0.0


# ------------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True)
class Loss:
    """A robust loss rho(s) on the squared whitened norm s; use one of the subclasses, or :func:`loss` by name."""

    #: Name as options spell it, and the number that selects the kernel; :func:`register_loss` sets both.
    name: ClassVar[str] = ""
    number: ClassVar[int] = -1

    def __post_init__(self) -> None:
        scale = getattr(self, "scale", 1.0)
        if not (math.isfinite(scale) and scale > 0.0):
            raise InputError(
                f"The scale of the loss {self.name!r} must be a positive number (standard deviations); got {scale}. "
                "Use the loss 'none' for plain least squares."
            )

    @property
    def tag(self) -> tuple[None, ...]:
        """What compiled loops take to select this loss."""
        if self.number < 0:
            raise InputError(f"The loss {type(self).__name__} has no kernel yet. Decorate it with register_loss.")
        return (None,) * (self.number + 1)

    @property
    def parameters(self) -> tuple[float, ...]:
        """The values of the fields, in their order, as the kernel takes them."""
        return tuple(float(getattr(self, field.name)) for field in fields(self))

    def scaled(self, factor: float) -> Loss:
        """Return the loss that bends at so many times the scale; one without a scale stays as it is."""
        scale = getattr(self, "scale", None)
        return self if scale is None or factor == 1.0 else replace(self, scale=factor * scale)  # type: ignore[call-arg]

    def evaluate(self, squared_norm: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return rho, rho' and rho'' at the squared whitened norms ``squared_norm`` (...)."""
        s = np.asarray(squared_norm, dtype=np.float64)
        out = np.empty((3, s.size))
        _evaluate_all(self.tag, self.parameters, np.ascontiguousarray(s).reshape(-1), out)
        return out[0].reshape(s.shape), out[1].reshape(s.shape), out[2].reshape(s.shape)


_L = TypeVar("_L", bound=type[Loss])
_LOSSES: dict[str, type[Loss]] = {}
#: One for every registration of this process.
_NUMBERS = itertools.count()
#: All losses by name, those of other packages too.
LOSSES: Mapping[str, type[Loss]] = MappingProxyType(_LOSSES)


def register_loss(name: str, derivatives: LossKernel) -> Callable[[_L], _L]:
    """Make a loss known by name, and its kernel to compiled loops; a decorator of frozen dataclasses.

    Parameters
    ----------
    name : str
        As options spell it: lower case, underscores. ``--loss`` and :attr:`groma.AdjustOptions.loss` then take it.
    derivatives : callable
        Kernel (decorated with :func:`groma.compiled.kernel`) that takes a tuple of the dataclass' fields, floats, and
        the squared norm, and returns rho, rho' and rho''. See the module for what rho promises;
        :func:`groma.testing.check_loss` checks it.

    Raises
    ------
    InputError
        If the name belongs to a loss of another module.
    """

    def decorate(cls: _L) -> _L:
        known = _LOSSES.get(name, cls)
        if known.__module__ != cls.__module__ or name == "none":
            raise InputError(
                f"A loss named {name!r} is registered already, by {known.__module__}. Choose another name."
            )
        cls.name, cls.number = name, next(_NUMBERS)
        _DERIVATIVES[cls.number + 1] = derivatives
        _LOSSES[name] = cls
        return cls

    return decorate


@register_loss("trivial", _trivial)
@dataclass(frozen=True)
class Trivial(Loss):
    """Plain least squares, rho(s) = s."""


@register_loss("huber", _huber)
@dataclass(frozen=True)
class Huber(Loss):
    """Quadratic up to ``scale``, linear beyond; convex."""

    #: Whitened norm at which the growth turns linear.
    scale: float = 1.0


@register_loss("soft_l1", _soft_l1)
@dataclass(frozen=True)
class SoftL1(Loss):
    """Smooth form of Huber; convex."""

    #: Whitened norm around which the growth turns linear.
    scale: float = 1.0


@register_loss("cauchy", _cauchy)
@dataclass(frozen=True)
class Cauchy(Loss):
    """Logarithmic growth; the usual choice for matches, with a scale near the noise level."""

    #: Whitened norm at which a factor has half its weight.
    scale: float = 1.0


@register_loss("tukey", _tukey)
@dataclass(frozen=True)
class Tukey(Loss):
    """Constant beyond ``scale``: outliers have no influence at all, so a good start is needed."""

    #: Whitened norm beyond which a factor has no weight.
    scale: float = 1.0


@register_loss("geman_mcclure", _geman_mcclure)
@dataclass(frozen=True)
class GemanMcClure(Loss):
    """Bounded and smooth."""

    #: Whitened norm at which a factor has a quarter of its weight.
    scale: float = 1.0


@register_loss("barron", _barron)
@dataclass(frozen=True)
class Barron(Loss):
    """The general family: ``alpha`` 2 is least squares, 1 soft L1, 0 Cauchy, -2 Geman-McClure, -inf Welsch."""

    #: Shape, at most 2.
    alpha: float = 1.0
    #: Whitened norm around which the loss leaves the parabola.
    scale: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.alpha <= 2.0:
            raise InputError(f"The shape alpha of the loss 'barron' must be at most 2; got {self.alpha}.")


@register_loss("truncated", _truncated)
@dataclass(frozen=True)
class Truncated(Loss):
    """Least squares cut off at ``scale``; not smooth there."""

    #: Whitened norm beyond which a factor has no weight.
    scale: float = 1.0


def loss(name: str, scale: float = 1.0, *, alpha: float | None = None) -> Loss:
    """Make a loss by name.

    Parameters
    ----------
    name : str
        ``trivial`` (or ``none``), ``huber``, ``soft_l1``, ``cauchy``, ``tukey``, ``geman_mcclure``, ``barron``,
        ``truncated`` or a registered one; a hyphen may stand for the underscore.
    scale : float
        Whitened residual norm at which the loss leaves the parabola; without effect on losses that have none.
    alpha : float, optional
        Shape, at most 2, for ``barron`` and others that have one.

    Returns
    -------
    Loss

    Raises
    ------
    InputError
        If there is no such loss, or a parameter is out of range.
    """
    check_kind(name, str, "name", "Pass the name of a loss, such as huber.")
    key = name.lower().replace("-", "_")
    key = "trivial" if key == "none" else key
    if key not in LOSSES:
        known = ["none", *sorted(set(LOSSES) - {"trivial"})]
        raise InputError(
            f"There is no loss named {name!r}; choose one of {', '.join(known)}.{did_you_mean(name, known)}"
        )
    given: dict[str, Any] = {"scale": float(scale)}
    names = {field.name for field in fields(LOSSES[key])}
    if alpha is not None:
        if "alpha" not in names:
            raise InputError(f"The loss {name!r} has no shape alpha, as 'barron' has; got alpha={alpha}. Leave it out.")
        given["alpha"] = float(alpha)
    return LOSSES[key](**{key: value for key, value in given.items() if key in names})
