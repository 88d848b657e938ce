# SPDX-License-Identifier: BSD-3-Clause
"""The factors of one pose, with all that stays as it is made ready: landmarks are held, and only pose and lens move."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.factors.contract import Factor
from groma.geometry.manifold import Manifold
from groma.localization.pose.records import times
from groma.problem.problem import Problem


@dataclass(frozen=True, eq=False)
class Part:
    """The matches of one kind."""

    factor: Factor
    #: ``points`` or ``lines``; and for each factor the row of its match.
    kind: str
    row: IntArray
    #: Slots of the factor, and what it reads of each: of pose and lens, nothing.
    slots: tuple[str, ...]
    held: tuple[FloatArray, ...]

    @property
    def has_lens(self) -> bool:
        """Whether the residual depends on the parameters of the camera."""
        return "intrinsics" in self.slots

    @property
    def landmarks(self) -> FloatArray:
        """(M, k) places of the landmarks in the world, in the order of the matches."""
        return self.held[self.slots.index(self.kind[:-1])]

    def of_rows(self, values: Mapping[str, BoolArray]) -> BoolArray:
        """What is said of the matches of this kind, in the order of the factors."""
        return values[self.kind][self.row]


@dataclass(frozen=True, eq=False)
class OnePose:
    """The problem of one pose and its matches."""

    parts: tuple[Part, ...]
    #: How a pose moves.
    chart: Manifold
    #: (7,) cam_from_world, and (p,) parameters of the camera.
    pose: FloatArray
    params: FloatArray

    @staticmethod
    def of(problem: Problem, params: FloatArray) -> OnePose:
        """The same of a problem with one pose and one camera with these parameters."""
        frames = problem.variables["frames"]
        held = {name: group.ambient() for name, group in problem.variables.items() if name in ("points", "lines")}
        parts = []
        for factor in problem.factors:
            references = factor.references()
            kind, row = next((ref.group, ref.index) for _, ref in references if ref.group in held)
            read = tuple(np.ascontiguousarray(held[r.group]) if r.group in held else np.zeros(0) for _, r in references)
            parts.append(Part(factor, kind, row, tuple(slot.name for slot, _ in references), read))
        return OnePose(tuple(parts), frames.manifold, frames.state[0], params)

    def at(self, pose: FloatArray, params: FloatArray) -> OnePose:
        """The same where the pose and the parameters of the camera are others."""
        return replace(self, pose=pose, params=params)

    def after(self, twist: FloatArray, params: FloatArray) -> OnePose:
        """The same after a left twist (6,), with other parameters."""
        return replace(self, pose=self.chart.retract(self.pose[None], twist[None])[0], params=params)

    def records(self, part: Part, wanted: Mapping[str, int]) -> FloatArray:
        """Derivatives by slots of so many coordinates, and the residual in the last column; not whitened."""
        begin, place = {}, 0
        for slot, size in wanted.items():
            begin[slot], place = place, place + size
        record = np.zeros((len(part.row), part.factor.residual_size, place + 1))
        self._write(part, begin, record)
        return record

    def write(self, record: FloatArray, lens: bool) -> None:
        """Write derivatives by the pose, by the parameters of the camera if ``lens``, and residuals of all parts."""
        begin, place = {"pose": 0, "intrinsics": 6 if lens else -1}, 0
        for part in self.parts:
            self._write(part, begin, record[place : place + len(part.row)])
            place += len(part.row)

    def _write(self, part: Part, begin: Mapping[str, int], record: FloatArray) -> None:
        inputs = part.factor.prepare(
            tuple(self._now.get(slot, own) for slot, own in zip(part.slots, part.held, strict=True))
        )
        part.factor.linearize(inputs, 0, len(record), tuple(begin.get(slot, -1) for slot in part.slots), record)

    @cached_property
    def _now(self) -> dict[str, FloatArray]:
        return {"pose": self.chart.ambient(self.pose[None]), "intrinsics": self.params[None]}

    def whitened(self, part: Part, wanted: Mapping[str, int]) -> FloatArray:
        """:meth:`records` by the noise of the image alone."""
        return times(part.factor.sqrt_information, self.records(part, wanted))
