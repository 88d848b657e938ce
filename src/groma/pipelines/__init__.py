# SPDX-License-Identifier: BSD-3-Clause
"""What a user came for: from scenes and images to better scenes."""
