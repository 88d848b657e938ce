# SPDX-License-Identifier: BSD-3-Clause
"""Depth images: their noise, planes in them, and depths of segments."""
