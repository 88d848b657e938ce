# SPDX-License-Identifier: BSD-3-Clause
"""Which segments of two images show the same edge: between views far apart, and by flow between neighbours."""
