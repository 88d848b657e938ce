# SPDX-License-Identifier: BSD-3-Clause
"""Scenes for programs that only look at them: glTF, DXF and rerun. They are written and not read."""
