# SPDX-License-Identifier: BSD-3-Clause
"""Closed forms and robust estimates: lines and their end points, planes, directions, structural relations."""
