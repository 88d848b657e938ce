# SPDX-License-Identifier: BSD-3-Clause
"""Mapping: from photographs to points, lines and planes.

In come photographs and perhaps a model of points. Stages follow one another (``map.py``): segments
(``image_segments.py``), lines (``lines``), the joint adjustment with weights from its residuals (``noise``), planes and
relations (``structure``). Each is a function whose result is kept (``checkpoints.py``), so that an interrupted run
continues; work per image goes through
:func:`groma.execution.map_work`. Out come a scene and a report (``result.py``).
"""
