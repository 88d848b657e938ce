# SPDX-License-Identifier: BSD-3-Clause
"""Are two scenes the same, or nearly? With a reason when they are not."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from groma._typing import FloatArray
from groma.scene.scene import Scene


@dataclass(frozen=True)
class Comparison:
    """A verdict that is true or false, with its reason."""

    #: Whether the scenes agree.
    same: bool
    #: Empty when they agree; else the first difference.
    reason: str = ""

    def __bool__(self) -> bool:
        return self.same


def equal(first: Scene, second: Scene) -> Comparison:
    """Tell whether two scenes hold exactly the same, bit by bit and in the same order."""
    for name, one, two in _columns(first, second):
        if reason := _shape_difference(name, one, two):
            return Comparison(False, reason)
        if isinstance(one, tuple):
            if one != two:
                row = next(i for i, (a, b) in enumerate(zip(one, two, strict=True)) if a != b)
                return Comparison(False, f"{name}[{row}] is {one[row]!r} in the first, {two[row]!r} in the second")
        elif not np.array_equal(one, two):
            row = int(np.argwhere(one != two)[0, 0])
            return Comparison(False, f"{name}[{row}] is {one[row]} in the first, {two[row]} in the second")
    return Comparison(True)


def near(first: Scene, second: Scene, tolerance: float = 1e-9) -> Comparison:
    """Tell whether two scenes hold the same up to rounding.

    Numbers may differ by ``tolerance`` times the larger of one and their size. Quaternions, planes and shared
    directions that differ by their sign only are the same.

    Parameters
    ----------
    first, second : Scene
        The scenes, in the same order of rows.
    tolerance : float
        Largest difference, relative to the larger of one and the number.
    """
    for name, one, two in _columns(first, second):
        if reason := _shape_difference(name, one, two):
            return Comparison(False, reason)
        if isinstance(one, tuple) or one.dtype.kind != "f":
            if one == two if isinstance(one, tuple) else np.array_equal(one, two):
                continue
            return Comparison(False, f"{name} differs")
        if one.size == 0:
            continue
        turned = _same_sign(name, one, two)
        difference = np.abs(one - turned) / np.maximum(1, np.maximum(np.abs(one), np.abs(turned)))
        if difference.max() > tolerance:
            row = int(np.unravel_index(difference.argmax(), difference.shape)[0])
            return Comparison(
                False,
                f"{name}[{row}] is {one[row]} in the first, {turned[row]} in the second: "
                f"relative difference {difference.max():.3g}, tolerance {tolerance:g}",
            )
    return Comparison(True)


def _columns(first: Scene, second: Scene) -> list[tuple[str, Any, Any]]:
    """Return every column of both scenes as (name, first, second)."""
    return [
        (f"{table.name}.{item.name}", *(getattr(getattr(scene, table.name), item.name) for scene in (first, second)))
        for table in fields(Scene)
        for item in fields(getattr(first, table.name))
    ]


def _shape_difference(name: str, one: Any, two: Any) -> str:
    shapes = [(len(value),) if isinstance(value, tuple) else value.shape for value in (one, two)]
    return "" if shapes[0] == shapes[1] else f"{name} has shape {shapes[0]} in the first, {shapes[1]} in the second"


def _same_sign(name: str, one: FloatArray, two: FloatArray) -> FloatArray:
    signed = {"rig_from_world": 4, "cam_from_rig": 4, "hesse": 3, "vectors": 3}
    flipped = {"rig_from_world": 4, "cam_from_rig": 4, "hesse": 4, "vectors": 3}
    kind = name.rpartition(".")[2]
    if kind not in signed:
        return two
    opposite = np.einsum("ij,ij->i", one[:, : signed[kind]], two[:, : signed[kind]]) < 0
    result = two.copy()
    result[opposite, : flipped[kind]] *= -1
    return result
