# SPDX-License-Identifier: BSD-3-Clause
"""From places of single segments to lines that many images see.

In come places and who supports them. Segments whose places agree are linked, lines are fitted to them and find the
segments that were missed, and lines that were mapped twice are merged. Out goes :class:`~.tracks.Tracks`: lines, their
observations, and what became of every segment.
"""
