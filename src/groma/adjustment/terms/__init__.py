# SPDX-License-Identifier: BSD-3-Clause
"""From tables of a scene to factors: one file per kind of measurement."""
