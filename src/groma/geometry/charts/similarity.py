# SPDX-License-Identifier: BSD-3-Clause
r"""The chart of similarities: :math:`S \leftarrow \mathrm{Exp}(\zeta)\,S` with :math:`\zeta = (\rho, \omega, \sigma)`.

A similarity ``cam_from_world`` is a pose whose camera has a unit of length of its own, as in the map of a single camera
whose scale drifts. State and what factors read are eight numbers: quaternion [x, y, z, w], translation, scale
(:mod:`groma.geometry.sim3`). Factors differentiate with respect to the left tangent :math:`\zeta`, so the basis is the
identity.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from groma._typing import FloatArray
from groma.geometry import quaternion, sim3
from groma.geometry.algebra import as_rows
from groma.geometry.charts.chart import as_steps
from groma.geometry.charts.registry import charts_of, register_chart
from groma.geometry.manifold import Manifold

#: No step changes the logarithm of a scale by more: the next one may go on from there (cost: another step).
_MAX_SIGMA = 20.0


@register_chart
class SimilarityLeft(Manifold):
    """Increments in the camera frame, ``"left"``: S <- Exp(zeta) S."""

    name: ClassVar[str] = "left"
    kind: ClassVar[str] = "similarity"
    state_size, ambient_size, factor_columns, dof = 8, 8, 7, 7

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        """Move similarities (N, 8) by left tangents (N, 7)."""
        state, delta = as_steps(state, delta, 8, 7)
        delta = np.column_stack([delta[:, :6], np.clip(delta[:, 6], -_MAX_SIGMA, _MAX_SIGMA)])
        return sim3.compose(sim3.exp(delta), state)

    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:
        """Left tangents (N, 7) from ``state`` to ``other``, with rotations of at most pi."""
        return sim3.log(sim3.compose(other, sim3.inverse(state)))

    def ambient(self, state: FloatArray) -> FloatArray:
        """The state, (N, 8), with a quaternion whose w is not negative."""
        state = as_rows(state, (8,), "state")
        return np.hstack([np.where(state[:, 3:4] < 0, -state[:, :4], state[:, :4]), state[:, 4:]])

    def from_ambient(self, ambient: FloatArray) -> FloatArray:
        """The numbers themselves, with a quaternion of length one."""
        ambient = as_rows(ambient, (8,), "ambient")
        return np.hstack([quaternion.normalize(ambient[:, :4]), ambient[:, 4:]])

    def basis(self, state: FloatArray) -> None:
        """The identity."""
        return None

    def random(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Rotations uniform on the sphere of quaternions, normal translations, scales from 0.4 to 2.5 in most cases."""
        turn = quaternion.normalize(rng.normal(size=(count, 4)))
        return np.hstack([turn, rng.normal(size=(count, 3)), np.exp(0.5 * rng.normal(size=(count, 1)))])


#: Charts of similarities by name, the default first, registered ones too.
SIMILARITY_CHARTS = charts_of("similarity")

__all__ = ["SIMILARITY_CHARTS", "SimilarityLeft"]
