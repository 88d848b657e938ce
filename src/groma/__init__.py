# SPDX-License-Identifier: BSD-3-Clause
"""groma: reconstruct and adjust scenes made of points, lines and planes."""

__version__ = "0.1.0"
