# SPDX-License-Identifier: BSD-3-Clause
"""Graphs: cameras and what was measured between them, without landmarks.

In come poses, or similarities where scales drift, and motions between them with their noise; they are adjusted,
optionally under a robust loss; out come cameras, and how far each motion is from them.
"""
