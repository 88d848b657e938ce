# SPDX-License-Identifier: BSD-3-Clause
"""Visualisation of scenes and solves. Imported on demand."""
