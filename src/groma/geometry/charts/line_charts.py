# SPDX-License-Identifier: BSD-3-Clause
r"""Charts of lines by name, the default first.

=====================  =============================================  ===========================================
name                   state                                          singular where
=====================  =============================================  ===========================================
``cartesian``          (m, d) with a unit direction                   nowhere; no lines at infinity
``orthonormal_right``  quaternion of U, angle phi; U <- U Exp         m = 0 or d = 0
``orthonormal_left``   the same; U <- Exp U                           m = 0 or d = 0
``free_right``         quaternion of R_WL, distance d_L; R <- R Exp   m = 0; no lines at infinity
``free_left``          the same; R <- Exp R                           m = 0; no lines at infinity
=====================  =============================================  ===========================================
"""

from __future__ import annotations

from groma.geometry.charts.line_cartesian import CartesianLine
from groma.geometry.charts.line_free import FreeLineLeft, FreeLineRight
from groma.geometry.charts.line_orthonormal import OrthonormalLineLeft, OrthonormalLineRight
from groma.geometry.charts.registry import charts_of, register_chart

for _chart in (CartesianLine, OrthonormalLineRight, OrthonormalLineLeft, FreeLineRight, FreeLineLeft):
    register_chart(_chart)
#: Charts of lines by name, registered ones too.
LINE_CHARTS = charts_of("line")

__all__ = [
    "LINE_CHARTS",
    "CartesianLine",
    "FreeLineLeft",
    "FreeLineRight",
    "OrthonormalLineLeft",
    "OrthonormalLineRight",
]
