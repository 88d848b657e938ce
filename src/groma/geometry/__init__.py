# SPDX-License-Identifier: BSD-3-Clause
"""What the objects are and how they move: groups, points, lines, planes, their algebra and their charts."""

from groma.geometry.manifold import Euclidean, Manifold

__all__ = ["Euclidean", "Manifold"]
