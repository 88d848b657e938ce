# SPDX-License-Identifier: BSD-3-Clause
"""Shared by commands: options, console, progress, interruption, atomic output."""
