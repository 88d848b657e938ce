# SPDX-License-Identifier: BSD-3-Clause
r"""Charts of planes by name, the default first.

====================  ===================================  ===================================================
name                  state                                singular where
====================  ===================================  ===================================================
``normal_offset``     (n, w) with a unit normal            nowhere; no plane at infinity
``quaternion_left``   unit (n, w); exp(delta) from left    nowhere; far planes crowd together
``quaternion_right``  unit (n, w); exp(delta) from right   nowhere; far planes crowd together
``closest_point``     foot point of the origin             planes through the origin; no plane at infinity
====================  ===================================  ===================================================
"""

from __future__ import annotations

from groma.geometry.charts.plane_closest_point import ClosestPointPlane
from groma.geometry.charts.plane_normal_offset import NormalOffsetPlane
from groma.geometry.charts.plane_quaternion import QuaternionPlaneLeft, QuaternionPlaneRight
from groma.geometry.charts.registry import charts_of, register_chart

for _chart in (NormalOffsetPlane, QuaternionPlaneLeft, QuaternionPlaneRight, ClosestPointPlane):
    register_chart(_chart)
#: Charts of planes by name, registered ones too.
PLANE_CHARTS = charts_of("plane")

__all__ = ["PLANE_CHARTS", "ClosestPointPlane", "NormalOffsetPlane", "QuaternionPlaneLeft", "QuaternionPlaneRight"]
