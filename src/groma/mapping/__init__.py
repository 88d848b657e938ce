# SPDX-License-Identifier: BSD-3-Clause
"""From photographs to a map of points, lines and planes.

In come photographs and perhaps a model of points. Stages follow one another (``map.py``): segments, lines (``lines``),
planes and relations (``structure``), the joint adjustment, weights from its residuals (``noise``). Each finished stage
is kept (``checkpoints.py``), so that an interrupted run goes on. Out come a scene and a report.
"""
