# SPDX-License-Identifier: BSD-3-Clause
r"""A line runs along a vanishing direction.

:math:`r = \hat d \times \hat v` with the line's direction d and the vanishing direction v: the residual, its kernel
and its derivatives are those of :mod:`groma.factors.relations.parallel`. Many lines share one direction, which is a
variable of its own: the direction gathers what all of them say, and stays in the reduced system while the lines are
eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from groma.factors.contract import Ref, Slot, register
from groma.factors.relations.parallel import ParallelDirectionPair


@register("line_direction")
@dataclass(frozen=True, kw_only=True)
class LineDirection(ParallelDirectionPair):
    """Lines parallel to vanishing directions, either way round. Degenerate for a line at infinity."""

    #: The lines, any scale of (m, d).
    line: Ref
    #: The vanishing directions.
    direction: Ref

    slots: ClassVar[tuple[Slot, ...]] = (Slot("line", "line"), Slot("direction", "direction"))
