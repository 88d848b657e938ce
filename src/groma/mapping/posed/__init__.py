# SPDX-License-Identifier: BSD-3-Clause
"""Photographs whose poses come from elsewhere: a phone, a drone, a robot, a network.

In come photographs and poses without points. Motions between two images (``motions.py``) follow from their matches
alone; all of them and the given poses together give better poses (``averaging.py``), or show that the axes of the file
are others than it says (``axes.py``). Points are triangulated there and everything is adjusted with the given poses as
measurements, whose noise is estimated and whose gross errors are found by a test (``noise.py``). ``register.py`` is the
stage. Out come a scene with points in the frame of the given poses, and sentences about what was wrong.
"""
