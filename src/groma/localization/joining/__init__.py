# SPDX-License-Identifier: BSD-3-Clause
"""Two maps of one place become one.

What comes in are two maps with their photographs. :mod:`merging` finds the motion between their worlds by what
photographs of one show of the other, and makes a model of all photographs, to be mapped, with what was measured of both
(:mod:`measurements`). What goes out is one map in the world of the first.
"""
