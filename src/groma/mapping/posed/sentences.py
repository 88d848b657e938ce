# SPDX-License-Identifier: BSD-3-Clause
"""Messages about given poses: their noise, wrong ones, and images left out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from groma._counted import first_of
from groma._typing import BoolArray, FloatArray
from groma.evaluation.alignment import camera_centers
from groma.geometry import quaternion
from groma.mapping.posed.axes import GATES as AXES
from groma.scene import Scene

#: Names in a sentence (convention: a sentence holds no more).
_NAMES = 12


def about_noise(place: float | None, turn: float | None, unit: float, count: int) -> list[str]:
    """Say how good the given poses are: standard deviations of a coordinate, in units of the file."""
    if place is None and turn is None:
        return [f"The {count} given poses agree with the photographs within their accuracy."]
    parts = [] if place is None else [f"{place * unit:.2g} units of length in each coordinate"]
    parts += [] if turn is None else [f"{np.degrees(turn):.2g} degrees about each axis"]
    return [f"Noise of the {count} given poses that were used, as the photographs show it: {' and '.join(parts)}."]


def about_contradiction(turn: float | None) -> list[str]:
    """Say that given poses and matches contradict each other, where orientations are off by what is no noise."""
    if turn is None or turn < AXES.cut:
        return []
    return [
        "The given poses and the matches contradict each other: orientations differ by "
        f"{np.degrees(turn):.2g} degrees, and the matches were followed. Objects that look alike from several sides "
        "give such matches: --fix-poses keeps the given poses. Else check that names and poses belong together."
    ]


def about_gross_errors(
    names: Sequence[str], gross: BoolArray, scene: Scene, given: FloatArray, unit: float
) -> list[str]:
    """Say which given poses were wrong, by how much, and that they were placed anew."""
    rows = np.flatnonzero(gross)
    if not len(rows):
        return []
    poses = scene.cam_from_world[rows]
    apart = unit * np.linalg.norm(camera_centers(poses) - camera_centers(given[rows]), axis=1)
    between = quaternion.multiply(poses[:, :4], quaternion.conjugate(given[rows, :4]))
    angle = np.degrees(np.linalg.norm(quaternion.log(between), axis=1))
    each = [
        f"{names[row]} ({distance:.3g} units, {degrees:.3g} degrees off)"
        for row, distance, degrees in zip(rows.tolist(), apart, angle, strict=True)
    ]
    if len(rows) == 1:
        return [f"The given pose of {each[0]} is wrong beyond its noise; its pose was estimated from its matches."]
    return [
        f"The given poses of {len(rows)} images are wrong beyond their noise; they were estimated from "
        f"matches: {first_of(each, _NAMES)}."
    ]


def about_left_out(names: Sequence[str], seen: BoolArray) -> list[str]:
    """Say which images share too few points with the others."""
    rows = np.flatnonzero(~seen)
    if not len(rows):
        return []
    listed = first_of([names[int(row)] for row in rows], _NAMES)
    return [
        f"{len(rows)} of {len(seen)} images see too few points of the others for their poses to be checked, and were "
        f"left out: {listed}."
    ]
