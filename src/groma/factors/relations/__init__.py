# SPDX-License-Identifier: BSD-3-Clause
"""Factors between landmarks: what lies on what, what is parallel or perpendicular; as lengths or in pixels."""
