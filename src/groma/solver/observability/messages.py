# SPDX-License-Identifier: BSD-3-Clause
"""Words for freedoms: how a camera, a plane or the whole scene can move without the data noticing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from groma._typing import FloatArray
from groma.solver.observability.gates import DIAGNOSIS

#: Name of a variable in sentences, from its group and its index.
Names = Callable[[str, int], str]


def axis(vector: FloatArray) -> str:
    """Return a direction as a person would write it: an axis of the world if it is near one, else three numbers."""
    unit = vector / np.linalg.norm(vector)
    k = int(np.argmax(np.abs(unit)))
    if abs(unit[k]) > DIAGNOSIS.axis:
        return "xyz"[k]
    unit = unit * (1.0 if unit[k] > 0 else -1.0)
    return "({:.2f}, {:.2f}, {:.2f})".format(*(unit + 0.0))


def listing(parts: list[str]) -> str:
    """Return "a", "a and b", "a, b and c"."""
    return parts[0] if len(parts) == 1 else ", ".join(parts[:-1]) + " and " + parts[-1]


def split(motions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Separate motions (6, k), shifts above turns, into pure shifts (3, a) and turns about axes (3, b)."""
    motions = np.linalg.qr(motions)[0] if motions.shape[1] else motions
    U, values, Vt = np.linalg.svd(motions[3:], full_matrices=True)
    values = np.concatenate([values, np.zeros(motions.shape[1] - len(values))])
    turning = values > DIAGNOSIS.visible
    shifts, few = motions[:3] @ Vt.T[:, ~turning], min(3, len(turning))
    turns = U[:, :few][:, turning[:few]]
    return np.linalg.svd(shifts, full_matrices=False)[0] if shifts.shape[1] else shifts, turns


def camera_freedom(motions: FloatArray, rotation: FloatArray) -> str:
    """Describe the free motions (6, k) of a camera in its frame, shifts above turns; ``rotation`` is R_cw."""
    if motions.shape[1] >= 6:
        return "move and turn in every way"
    shifts, turns = split(motions)
    shifts, turns = rotation.T @ shifts, rotation.T @ turns
    return listing(_shift_words(shifts) + _turn_words(turns))


def _shift_words(shifts: FloatArray) -> list[str]:
    if shifts.shape[1] == 0:
        return []
    if shifts.shape[1] == 1:
        return [f"move along {axis(shifts[:, 0])}"]
    if shifts.shape[1] == 2:
        return [f"move in the plane perpendicular to {axis(np.cross(shifts[:, 0], shifts[:, 1]))}"]
    return ["move in every direction"]


def _turn_words(turns: FloatArray) -> list[str]:
    if turns.shape[1] == 0:
        return []
    if turns.shape[1] == 3:
        return ["turn about every axis"]
    if turns.shape[1] == 2:
        return [f"turn about every axis perpendicular to {axis(np.cross(turns[:, 0], turns[:, 1]))}"]
    return [f"turn about {axis(turns[:, 0])}"]


def plane_freedom(motions: FloatArray, normal: FloatArray) -> str:
    """Describe the free motions (4, k) of a plane: a shift along its normal above the change of the normal."""
    if motions.shape[1] >= 3:
        return "move and turn in every way"
    U, values, _ = np.linalg.svd(motions[1:], full_matrices=False)
    turning = U[:, values > DIAGNOSIS.visible * max(float(np.linalg.norm(motions)), 1e-300)]
    if turning.shape[1] == 2:
        return "turn about every axis in it"
    if turning.shape[1] == 1:
        words = f"turn about {axis(np.cross(normal, turning[:, 0]))}"
        return words if motions.shape[1] == 1 else f"{words} and shift along its normal"
    return "shift along its normal"


def scene_freedom(combinations: FloatArray) -> list[str]:
    """Describe free motions (7, k) of the whole scene: translation, rotation, scale."""
    if combinations.shape[1] == 0:
        return []
    Q = np.linalg.qr(combinations)[0]
    scaling = np.linalg.norm(Q[6]) > DIAGNOSIS.visible
    if scaling:  # the part without scale
        direction = Q[6] / np.linalg.norm(Q[6])
        rest = Q @ _complement(direction)
    else:
        rest = Q
    words = []
    shifts, turns = split(rest[:6]) if rest.shape[1] else (np.zeros((3, 0)), np.zeros((3, 0)))
    motions = ("translation", shifts, "", "along "), ("rotation", turns, "about every axis ", "about ")
    for name, moved, plane, line in motions:
        if moved.shape[1] == 3:
            words.append(name)
        elif moved.shape[1] == 2:
            words.append(f"{name} {plane}perpendicular to {axis(np.cross(moved[:, 0], moved[:, 1]))}")
        elif moved.shape[1] == 1:
            words.append(f"{name} {line}{axis(moved[:, 0])}")
    return words + (["scale"] if scaling else [])


def _complement(unit: FloatArray) -> FloatArray:
    U, _, _ = np.linalg.svd(unit[:, None], full_matrices=True)
    return U[:, 1:]
