# SPDX-License-Identifier: BSD-3-Clause
"""3D lines from the segments of posed images.

In come segments and perhaps matches. Neighbouring images propose places in space for every segment, and the place on
which most of them agree is kept (``hypotheses``). Segments with the same place are linked to lines, which recover
further segments and are merged (``linking``), and what is not well determined, texture or a duplicate is rejected
(``filtering``). ``build.py`` is the order of these stages, and ``by_clusters.py`` that of very many images, which are
mapped cluster by cluster and joined across borders. Out comes a :class:`~groma.mapping.lines.line_map.LineMap`: lines,
their observations, and the rejection reason of every other segment.
"""
