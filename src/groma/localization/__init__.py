# SPDX-License-Identifier: BSD-3-Clause
"""Localisation: the pose of a camera in an existing map.

What comes in is a map (a scene with its photographs, described once in :mod:`map_index`, with how wrong it
is by :mod:`errors.map_errors`) and a photograph.
:mod:`retrieval` says which images of the map to compare with, :mod:`candidates` pairs points and segments of the query
with landmarks, :mod:`pose` estimates and judges the pose, :mod:`localizer` is all of it for one photograph, :mod:`run`
for many. What goes out is a pose with its uncertainty or a clear no, and the folder that :mod:`result` writes.
"""
