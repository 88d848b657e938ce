# SPDX-License-Identifier: BSD-3-Clause
"""Adjustment of a scene that is too large for memory or for a machine, in parts on disk.

A part is a groma archive (``.npz``). All parts have the same cameras, images and poses; each has landmarks of its own,
with all their observations. Parts belong to processes, one or many; see :mod:`groma.solver.reduce.shards`. ``cut.py``
makes parts of a scene, ``opened.py`` makes variables of parts, ``adjust.py`` solves and writes them, and
``checkpoint.py`` keeps where it stands. Points and lines take part; planes, directions and relations do not.
"""

from groma.adjustment.parts.adjust import PartsResult, adjust_parts
from groma.adjustment.parts.cut import PART_SIZE, is_parts_folder, parts_of, write_parts

__all__ = ["PART_SIZE", "PartsResult", "adjust_parts", "is_parts_folder", "parts_of", "write_parts"]
