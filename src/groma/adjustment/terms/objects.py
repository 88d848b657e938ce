# SPDX-License-Identifier: BSD-3-Clause
"""Objects that measurements refer to by kind and index: their variables, their names, and rows of one kind."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.factors.contract import Ref
from groma.geometry import se3
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.scene import Scene
from groma.scene.survey import Kind

#: The group of variables of each kind, and what factors call it.
GROUPS = {
    Kind.IMAGE: "frames", Kind.CONTROL_POINT: "control_points", Kind.LINE: "lines", Kind.PLANE: "planes",
    Kind.POINT: "points", Kind.DIRECTION: "directions",
}  # fmt: skip
SLOTS = {
    Kind.IMAGE: "camera", Kind.CONTROL_POINT: "point", Kind.LINE: "line", Kind.PLANE: "plane",
    Kind.POINT: "point", Kind.DIRECTION: "direction",
}  # fmt: skip


def rows_by_kind(groups: Collection[str], *kinds: IntArray) -> Iterator[tuple[tuple[Kind, ...], IntArray]]:
    """Yield kinds and the rows that have them, of those whose groups of variables take part."""
    if len(kinds[0]) == 0:
        return
    for found in np.unique(np.stack(kinds, axis=1), axis=0):
        named = tuple(Kind(kind) for kind in found)
        if all(GROUPS[kind] in groups for kind in named):
            yield named, np.flatnonzero((np.stack(kinds, axis=1) == found).all(axis=1))


def ref_of(scene: Scene, kind: Kind, index: IntArray) -> Ref:
    """Return the reference to objects of one kind; of images to their frames."""
    return Ref(GROUPS[kind], scene.images.frame_idx[index] if kind == Kind.IMAGE else index)


def arms_of(scene: Scene, kind: Kind, index: IntArray, anchor: FloatArray) -> FloatArray:
    """Return what factors need to find a place on objects: the centres of cameras on their rigs, else the anchors."""
    if kind != Kind.IMAGE:
        return anchor
    return se3.inverse(scene.sensors.cam_from_rig[scene.images.sensor_idx[index]])[:, 4:]


def name_of(scene: Scene, kind: int, index: int) -> str:
    """Return the readable name of an object."""
    if kind in (Kind.IMAGE, Kind.CONTROL_POINT):
        return (scene.images if kind == Kind.IMAGE else scene.control_points).names[index]
    table = (scene.lines, scene.planes, scene.points, scene.directions)[kind - Kind.LINE]
    return f"{SLOTS[Kind(kind)]}:{table.ids[index]}"


def with_held(variables: dict[str, Variables], scene: Scene) -> dict[str, Variables]:
    """Return the variables with the objects that the scene holds constant."""
    if not len(scene.held):
        return variables
    found = dict(variables)
    for (kind,), rows in rows_by_kind(variables.keys(), scene.held.kind):
        ref = ref_of(scene, kind, scene.held.idx[rows])
        group = variables[ref.group]
        mask: BoolArray = np.zeros(len(group), bool)
        mask[ref.index] = True
        before = np.asarray(group.constant)
        found[ref.group] = replace(group, constant=before | (mask[:, None] if before.ndim == 2 else mask))
    return found


def with_held_states(before: Problem, after: Problem, moved: IntArray) -> tuple[Problem, IntArray]:
    """Return a problem whose landmarks were started anew with the held ones where they were, and the lines that moved.

    A rescue solves for landmarks one by one and compares their costs; it must not move those that are held.
    """
    held = {name: group.free_coordinates() for name, group in before.variables.items()}
    rows = {name: np.flatnonzero(~free.any(axis=1)) for name, free in held.items() if free is not None}
    states = {}
    for name, mine in rows.items():
        state = after.variables[name].state.copy()
        state[mine] = before.variables[name].state[mine]
        states[name] = state
    if not states:
        return after, moved
    return after.with_states(states), np.setdiff1d(moved, rows.get("lines", np.zeros(0, np.int64)))
