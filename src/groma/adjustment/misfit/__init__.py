# SPDX-License-Identifier: BSD-3-Clause
"""Model errors shown by residuals: unmodelled lens distortion, rigs that are not rigid, motions that may be turns."""
