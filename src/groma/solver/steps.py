# SPDX-License-Identifier: BSD-3-Clause
"""A step of all free variables, and moving the states by it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray
from groma.problem.layout import Layout
from groma.problem.linearization import NormalEquations

States = dict[str, FloatArray]
#: About so many states of a group are looked at for the one of middle length.
SAMPLE = 4096


@dataclass(frozen=True)
class Step:
    """Increments, flat: of the kept blocks by class and of the landmarks by eliminated group."""

    kept: list[FloatArray]
    landmarks: list[FloatArray]

    def parts(self) -> list[FloatArray]:
        """Return all arrays of the step."""
        return self.kept + self.landmarks

    def dot(self, other: Step) -> float:
        """Return the inner product with another step."""
        return float(sum(a @ b for a, b in zip(self.parts(), other.parts(), strict=True)))

    def norm(self) -> float:
        """Return the Euclidean length."""
        return float(np.sqrt(self.dot(self)))

    def scaled(self, factor: float) -> Step:
        """Return a multiple of the step."""
        return Step([factor * part for part in self.kept], [factor * part for part in self.landmarks])


def retract(layout: Layout, states: States, step: Step) -> States:
    """Return the states moved by a step, each group through its chart."""
    new = dict(states)
    for kept, delta in zip(layout.kept, step.kept, strict=True):
        blocks = delta.reshape(kept.count, kept.width)
        for member in kept.members:
            part = blocks[:, member.offset : member.offset + member.dof]
            if member.block_of is not None:
                part = part[member.block_of]
            manifold = layout.problem.variables[member.group].manifold
            new[member.group] = manifold.retract(states[member.group], np.ascontiguousarray(part))
    for group, delta in zip(layout.eliminated, step.landmarks, strict=True):
        manifold = layout.problem.variables[group.group].manifold
        new[group.group] = manifold.retract(states[group.group], delta.reshape(group.count, group.dof))
    return new


def size_of(states: States) -> float:
    """Return the Euclidean length of all states together, if each were as long as the middle one of its group.

    A few points at a great distance, as wrong matches make them, would otherwise make every step look negligible.
    """
    squares = 0.0
    for state in states.values():
        rows = state[:: 1 + len(state) // SAMPLE]
        if len(rows):
            squares += len(state) * float(np.median(np.einsum("ij,ij->i", rows, rows)))
    return float(np.sqrt(squares)) + 1e-12


def gradient(equations: NormalEquations) -> Step:
    """Return the gradient of the cost."""
    return Step(equations.g_kept, equations.g_landmarks)


def largest(step: Step) -> float:
    """Return the largest component of a step."""
    return max((float(np.abs(part).max()) for part in step.parts() if part.size), default=0.0)
