# SPDX-License-Identifier: BSD-3-Clause
"""A map that is mapped again: what goes along from the model that it was to the map that it becomes.

What comes in is a model with lines and planes, some of them measured in cameras, and the map that was made of its
photographs and points. :mod:`measured` gives depths of segments and planes to what is found anew, and
:mod:`kept_lines` puts back lines that were not found. What goes out is a map that has what was measured.
"""
