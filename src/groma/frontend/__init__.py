# SPDX-License-Identifier: BSD-3-Clause
"""Lines in images: detect, describe, match."""
