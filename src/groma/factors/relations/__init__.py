# SPDX-License-Identifier: BSD-3-Clause
"""Factors between landmarks: incidence, parallelism and perpendicularity, as lengths or in pixels."""
