# SPDX-License-Identifier: BSD-3-Clause
"""Charts: how lines, planes, points, directions, poses and similarities are stored and moved by a minimal increment.

In come states and increments; a chart retracts one by the other, and gives the derivative of the coordinates that
factors read by the increment. Solver, tests and factors' checks use the same ``retract``. Every chart fulfils
:class:`groma.geometry.manifold.Manifold`; a new one is one file, made known
by :func:`register_chart`.
"""

from groma.geometry.charts import line_charts, plane_charts, point3, pose_charts, similarity, unit3
from groma.geometry.charts.registry import charts_of, register_chart

__all__ = ["charts_of", "line_charts", "plane_charts", "point3", "pose_charts", "register_chart", "similarity", "unit3"]
