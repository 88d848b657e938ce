# SPDX-License-Identifier: BSD-3-Clause
"""Factors that hold variables without an image: measured poses, motions between them, positions, parameters."""
