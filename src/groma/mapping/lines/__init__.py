# SPDX-License-Identifier: BSD-3-Clause
"""3D lines from the segments of posed images.

In come segments and perhaps matches. Neighbouring images propose places in space for every segment (``proposals.py``,
``known_points.py``); the place on which most of them agree is kept (``consensus.py``, ``places.py``). Segments with the
same place are linked to lines (``link.py``), which recover further segments (``growth.py``), are merged (``merge.py``)
and filtered (``filters.py``). Out comes a :class:`~groma.mapping.lines.line_map.LineMap`: lines, their observations,
and the rejection reason of every other segment.
"""
