# SPDX-License-Identifier: BSD-3-Clause
"""One frame: its camera, features, segments, depth and planes, and the tables of its measurements."""
