# SPDX-License-Identifier: BSD-3-Clause
"""Where in space one segment may lie, and where it does.

In come segments with rays and depth ranges (:mod:`groma.mapping.lines.views`). Every neighbouring image, known points
and vanishing directions propose places; the place that most of them support is taken. Out go places with covariances
and the segments that support them.
"""
