# SPDX-License-Identifier: BSD-3-Clause
"""3D lines from the segments of posed images.

In come segments and matches; every segment gets proposals of its place in space from its neighbours (``proposals.py``),
the place that most images agree on (``consensus.py``, ``places.py``), and joins a track (``tracks.py``). Tracks are
merged (``merge.py``), rid of duplicates and texture, fitted and cut to their ends. Out comes a
:class:`~groma.mapping.lines.line_map.LineMap`: lines, who sees them, and why every other segment was left out.
"""
