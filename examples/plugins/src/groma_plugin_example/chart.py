# SPDX-License-Identifier: BSD-3-Clause
"""A chart: lines as in the chart ``cartesian``, their shifts counted in hundredths of the scene's unit."""

import numpy as np

from groma.geometry.charts import register_chart
from groma.geometry.charts.line_charts import CartesianLine

#: Of two angles and two shifts.
UNITS = np.array([1.0, 1.0, 0.01, 0.01])


@register_chart
class CentimetreLine(CartesianLine):
    """For scenes in metres: an increment of one is a radian or a centimetre."""

    name = "centimetres"

    def retract(self, state, delta):
        return super().retract(state, np.asarray(delta) * UNITS)

    def local(self, state, other):
        return super().local(state, other) / UNITS

    def basis(self, state):
        return super().basis(state) * UNITS
