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

from groma.geometry._manifold import Manifold
from groma.geometry.plane_closest_point import ClosestPointPlane
from groma.geometry.plane_normal_offset import NormalOffsetPlane
from groma.geometry.plane_quaternion import QuaternionPlaneLeft, QuaternionPlaneRight

#: Charts of planes by name.
PLANE_CHARTS: dict[str, Manifold] = {
    chart.name: chart
    for chart in (NormalOffsetPlane(), QuaternionPlaneLeft(), QuaternionPlaneRight(), ClosestPointPlane())
}

__all__ = ["PLANE_CHARTS", "ClosestPointPlane", "NormalOffsetPlane", "QuaternionPlaneLeft", "QuaternionPlaneRight"]
