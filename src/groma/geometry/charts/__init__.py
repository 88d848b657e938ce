# SPDX-License-Identifier: BSD-3-Clause
"""Charts: how lines, planes, points, directions and poses are stored and moved by a minimal increment.

In come states and increments; a chart retracts one by the other, and gives the derivative of the coordinates that
factors read by the increment. Solver, tests and factors' checks use the same ``retract``. Every chart fulfils
:class:`groma.geometry.manifold.Manifold`; a new one is one file.
"""
