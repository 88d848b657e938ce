# SPDX-License-Identifier: BSD-3-Clause
"""Closed forms and robust estimates: lines from segments and where they end, planes, directions, what lies on what."""
