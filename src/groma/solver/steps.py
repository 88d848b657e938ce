# SPDX-License-Identifier: BSD-3-Clause
"""A step of all free variables, and moving the states by it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray
from groma.geometry.manifold import Manifold
from groma.problem.layout import Layout

States = dict[str, FloatArray]
#: Approximate number of states of a group whose median length is taken (Cost: time only).
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
    for manifold, name, delta in parts_of(layout, step):
        new[name] = manifold.retract(states[name], delta)
    return new


def squares_of_step(manifold: Manifold, delta: FloatArray) -> FloatArray:
    """Return the squared Euclidean length of the lengths, of the turns of cameras and of all else in a step (3,).

    They are compared with the states one by one, so that the unit of length does not decide which of them count.
    """
    if manifold.kind == "pose":
        squares = np.einsum("ij,ij->j", delta, delta)
        return np.array([float(squares[:3].sum()), float(squares[3:].sum()), 0.0])
    flat = delta.reshape(-1)
    total = float(flat @ flat)
    return np.array([total, 0.0, 0.0] if manifold.kind == "point" else [0.0, 0.0, total])


def squares_of_states(manifold: Manifold, state: FloatArray) -> FloatArray:
    """Return the same of states, if each were as long as the middle one of its group; a turn is compared with 1.

    A few points at a great distance, as wrong matches make them, would otherwise make every step look negligible.
    """
    rows = state[:: 1 + len(state) // SAMPLE]
    if len(rows) == 0:
        return np.zeros(3)
    if manifold.kind in ("point", "pose"):
        ambient = manifold.ambient(rows)
        rows = ambient if manifold.kind == "point" else ambient[:, 3::4]
    length = len(state) * float(np.median(np.einsum("ij,ij->i", rows, rows)))
    if manifold.kind == "pose":
        return np.array([length, len(state), 0.0])
    return np.array([length, 0.0, 0.0] if manifold.kind == "point" else [0.0, 0.0, length])


def share_of_states(step: FloatArray, states: FloatArray) -> float:
    """Return how large a step is for the states: the largest of its three parts, relative to the same of the states."""
    moved = step > 0.0
    if not moved.any():
        return 0.0
    with np.errstate(over="ignore"):  # states that are all zero: no share is larger
        return float(np.sqrt(np.max(step[moved] / np.maximum(states[moved], np.finfo(float).tiny))))


def sizes_of(layout: Layout, states: States) -> FloatArray:
    """Return :func:`squares_of_states` of all free variables together."""
    members = [member.group for kept in layout.kept for member in kept.members]
    names = [*members, *(group.group for group in layout.eliminated)]
    variables = layout.problem.variables
    return sum((squares_of_states(variables[name].manifold, states[name]) for name in names), np.zeros(3))


def relative_length(layout: Layout, sizes: FloatArray, step: Step) -> float:
    """Return :func:`share_of_states` of a step of all free variables, for states of these :func:`sizes_of`."""
    squares = np.zeros(3)
    for manifold, _, delta in parts_of(layout, step):
        squares += squares_of_step(manifold, delta)
    return share_of_states(squares, sizes)


def parts_of(layout: Layout, step: Step) -> Iterator[tuple[Manifold, str, FloatArray]]:
    """Yield chart, name and increments (count, dof) of every group in a step."""
    variables = layout.problem.variables
    for kept, delta in zip(layout.kept, step.kept, strict=True):
        blocks = delta.reshape(kept.count, kept.width)
        for member in kept.members:
            part = blocks[:, member.columns]
            if member.block_of is not None:
                part = part[member.block_of]
            yield variables[member.group].manifold, member.group, np.ascontiguousarray(part)
    for group, delta in zip(layout.eliminated, step.landmarks, strict=True):
        yield variables[group.group].manifold, group.group, delta.reshape(group.count, group.dof)


def largest_slope(gradient: FloatArray, curvature: FloatArray) -> float:
    r"""Return the largest component of a gradient, each divided by the root of its curvature.

    Half its square is what moving that coordinate alone would gain, whatever its unit.
    """
    roots = np.sqrt(np.maximum(curvature, np.finfo(float).tiny))
    return float(np.max(np.abs(gradient) / roots, initial=0.0))
