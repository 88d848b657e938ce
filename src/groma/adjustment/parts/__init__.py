# SPDX-License-Identifier: BSD-3-Clause
"""Adjustment of a scene that is too large for memory or for a machine, in parts on disk.

A part is a groma archive (``.npz``). All parts have the same cameras, images, poses, planes and directions; each has
some of the points and lines, with all their observations and relations. Parts belong to processes, one or many; see
:mod:`groma.solver.reduce.shards`. ``cut.py`` makes parts of a scene, and a scene of parts, ``opened.py`` makes
variables of parts, ``adjust.py`` solves and writes them, and ``checkpoint.py`` keeps where it stands.
"""

from groma.adjustment.parts.adjust import PartsResult, adjust_parts
from groma.adjustment.parts.cut import PART_SIZE, join_parts, num_ties_cut, parts_of, write_parts

__all__ = ["PART_SIZE", "PartsResult", "adjust_parts", "join_parts", "num_ties_cut", "parts_of", "write_parts"]
