# SPDX-License-Identifier: BSD-3-Clause
"""The factors of one pose, with all that stays as it is made ready: landmarks are held, and only pose and lens move."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.factors.contract import Factor
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.localization.pose.records import times

_CHART = POSE_CHARTS["left"]


@dataclass(frozen=True, eq=False)
class Part:
    """The matches of one kind."""

    #: Of pose, landmark and, some of them, the parameters of the camera, in this order.
    factor: Factor
    #: ``points`` or ``lines``; and for each factor the row of its match.
    kind: str
    row: IntArray
    #: (M, k) places of the landmarks in the world, in the order of the matches.
    landmarks: FloatArray

    @property
    def has_lens(self) -> bool:
        """Whether the residual depends on the parameters of the camera."""
        return len(self.factor.references()) > 2

    @cached_property
    def noise(self) -> FloatArray:
        """(M, 2, 2) inverse noise of the image."""
        return np.broadcast_to(times(self.factor.sqrt_information, np.eye(2)[None]), (len(self.row), 2, 2))

    def of_rows(self, values: Mapping[str, BoolArray]) -> BoolArray:
        """What is said of the matches of this kind, in the order of the factors."""
        return values[self.kind][self.row]


@dataclass(frozen=True, eq=False)
class OnePose:
    """The problem of one pose and its matches."""

    parts: tuple[Part, ...]
    #: (7,) cam_from_world, and (p,) parameters of the camera.
    pose: FloatArray
    params: FloatArray

    def at(self, pose: FloatArray, params: FloatArray) -> OnePose:
        """The same where the pose and the parameters of the camera are others."""
        return replace(self, pose=pose, params=params)

    def after(self, twist: FloatArray, params: FloatArray) -> OnePose:
        """The same after a left twist (6,), with other parameters."""
        return self.at(_CHART.retract(self.pose[None], twist[None])[0], params)

    def records(self, part: Part, *wanted: str) -> FloatArray:
        """Derivatives by ``pose``, ``landmark`` and ``lens``, those that are wanted, in this order, and the residual in
        the last column; not whitened.
        """
        columns, width = [], 0
        for name, size in (("pose", 6), ("landmark", part.landmarks.shape[1]), ("lens", len(self.params))):
            columns.append(width if name in wanted else -1)
            width += size if name in wanted else 0
        record = np.zeros((len(part.row), part.factor.residual_size, width + 1))
        self._write(part, columns, record)
        return record

    def whitened(self, part: Part, *wanted: str) -> FloatArray:
        """:meth:`records` by the noise of the image alone."""
        return times(part.factor.sqrt_information, self.records(part, *wanted))

    def write(self, record: FloatArray, lens: bool) -> None:
        """Write derivatives by the pose, by the parameters of the camera if ``lens``, and residuals of all parts."""
        place = 0
        for part in self.parts:
            self._write(part, [0, -1, 6 if lens else -1], record[place : place + len(part.row)])
            place += len(part.row)

    def _write(self, part: Part, columns: list[int], record: FloatArray) -> None:
        count = 2 + part.has_lens
        inputs = part.factor.prepare((self._motion, part.landmarks, self.params[None])[:count])
        part.factor.linearize(inputs, 0, len(record), tuple(columns[:count]), record)

    @cached_property
    def _motion(self) -> FloatArray:
        return _CHART.ambient(self.pose[None])
