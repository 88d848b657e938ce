# SPDX-License-Identifier: BSD-3-Clause
"""What a depth image says: its noise, the planes in it, and the depths of segments."""
