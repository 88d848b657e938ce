# SPDX-License-Identifier: BSD-3-Clause
"""LIMAP 2's ``structures`` folder beside a COLMAP model: lines, planes, vanishing directions, points on lines."""
