# SPDX-License-Identifier: BSD-3-Clause
r"""A loss: Welsch, :math:`\rho(s) = c^2 (1 - e^{-s/c^2})`."""

import math
from dataclasses import dataclass

from groma.compiled import kernel
from groma.factors import Loss, register_loss


@kernel
def welsch(parameters, s):
    c2 = parameters[0] * parameters[0]
    weight = math.exp(-s / c2)
    return -c2 * math.expm1(-s / c2), weight, -weight / c2


@register_loss("welsch", welsch)
@dataclass(frozen=True)
class Welsch(Loss):
    """Bounded; what lies beyond two scales hardly counts."""

    #: Whitened norm at which a factor has 37 % of its weight.
    scale: float = 1.0
