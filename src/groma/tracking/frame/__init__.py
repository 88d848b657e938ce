# SPDX-License-Identifier: BSD-3-Clause
"""What one frame gives: its camera, features, segments, depth and planes; and the tables of what it measured."""
