# SPDX-License-Identifier: BSD-3-Clause
"""Measurements of other instruments: from files to tables of a scene, and from a solution to a surveyor's protocol.

Files of positions, poses, control points, distances, planes and directions come in
(:class:`~groma.adjustment.survey.given.Survey`).
:mod:`~groma.adjustment.survey.attach` finds the images they belong to, brings the scene into their frame by a robust
similarity (:mod:`~groma.adjustment.survey.similarity`) and adds the tables, which every later adjustment uses. After
it, :mod:`~groma.adjustment.survey.reliability` says of each measurement how well it was checked by the others, and
:mod:`~groma.adjustment.survey.protocol` writes it down.
"""
