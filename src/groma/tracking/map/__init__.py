# SPDX-License-Identifier: BSD-3-Clause
"""The growing map: landmarks and keyframes, which segment is which line, and what a keyframe adds."""
