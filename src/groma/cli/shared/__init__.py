# SPDX-License-Identifier: BSD-3-Clause
"""What commands share: text, progress, interruption, whole or no output."""
