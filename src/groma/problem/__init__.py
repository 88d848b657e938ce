# SPDX-License-Identifier: BSD-3-Clause
"""Variables and factors, and how they are laid out in memory."""
