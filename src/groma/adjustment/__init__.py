# SPDX-License-Identifier: BSD-3-Clause
"""The joint adjustment of a scene.

In comes a scene. ``assemble.py`` turns its tables of measurements into the factors of a problem (one file of ``terms``
per kind of measurement), ``adjust.py`` solves it under one loss after the other and brings lines that settled in wrong
places back (``rescue``), and out come a new scene and a report. Pose graphs, scenes in parts, uncertainty, diagnosis
and what each kind of landmark contributes go the same way.
"""
