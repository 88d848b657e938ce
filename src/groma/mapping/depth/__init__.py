# SPDX-License-Identifier: BSD-3-Clause
"""Depth maps of photographs in a map: unit of length, noise, depths of points and of segments.

In come an adjusted model of points and a folder of depth maps (:mod:`groma.io.depth_maps`). Points determine the unit,
or that of each map (``unit.py``), and how much depths err (``noise.py``); depths at points and beside segments become
measurements of the scene (``points.py``, ``segments.py``), like those of RGB-D sequences. Out come scenes.
"""
