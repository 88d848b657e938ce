# SPDX-License-Identifier: BSD-3-Clause
"""Closed forms and robust estimates: triangulation, trimming, plane fits, directions, alignment."""
