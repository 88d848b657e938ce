# SPDX-License-Identifier: BSD-3-Clause
"""Geometry: groups, points, lines and planes, their algebra and their charts."""

from groma.geometry.manifold import Euclidean, Manifold

__all__ = ["Euclidean", "Manifold"]
