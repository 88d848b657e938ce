# SPDX-License-Identifier: BSD-3-Clause
"""Formats for viewing, written and not read: glTF, DXF and rerun."""
