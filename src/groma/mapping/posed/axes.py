# SPDX-License-Identifier: BSD-3-Clause
r"""Whether the axes of given poses are those that the photographs show.

Motions between pairs of images are independent of the poses. If all poses have cameras with axes turned by a matrix A
of signs and exchanges, the rotation of a pair is :math:`A R A^\top`; if the poses go the other way, from the camera to
the world, it is that of the inverses; if the places alone have exchanged or turned axes W, the directions between the
centres are off by W and the rotations are not. Each such reading is scored by how far rotations and directions are off,
cut at an angle from which a motion says no more than that it disagrees. The file is refused where another reading
explains the motions by far better than its own; it is not turned.

Rotations of the camera do not distinguish a mirrored world from turned axes: :math:`M R M = (-M) R (-M)` for a
reflection M. The directions between the centres do.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from groma._typing import FloatArray
from groma.errors import InputError
from groma.gates import NORMAL, gate
from groma.geometry import quaternion
from groma.mapping.posed.motions import Motions
from groma.scene import Scene

#: Metres of a degree of latitude.
_DEGREE = 111_195.0


@dataclass(frozen=True)
class AxesGates:
    """When the axes of a file are refused."""

    cut: float = gate(np.radians(40.0), "rad", "at which disagreement counts no more", "convention: half a right angle")
    better: float = gate(0.5, "share", "of the score of the file's reading: another is right", "chosen on fountain-P11")
    kept: float = gate(0.8, "share", "of the pairs, those that agree best", "convention: 10 %, twice")
    shuffles: int = gate(99, "orders", "of the poses, at random", "cost: tells one in a hundred")
    fewest: int = gate(5, "images", "for which such a comparison tells something", "derived from 120 orders of five")


GATES = AxesGates()


@dataclass(frozen=True, eq=False)
class Reading:
    """One way to read the poses of a file."""

    #: What is likely wrong with the file, if this fits: completes "the photographs fit if".
    words: str
    #: (N, 3, 3) rotations of the cameras from the world, and (N, 3) centres.
    rotation: FloatArray
    centers: FloatArray


def check_axes(scene: Scene, motions: Motions) -> None:
    """Refuse poses that fit the motions far better if their axes are read otherwise.

    Raises
    ------
    InputError
        With the reading that fits.
    """
    rotation, centers = quaternion.to_matrix(scene.cam_from_world[:, :4]), scene.cam_centers_in_world
    own = score(Reading("", rotation, centers), motions)
    scored = [(score(reading, motions), reading) for reading in readings(rotation, centers)]
    best, reading = min(scored, key=lambda one: one[0])
    if best <= GATES.better * own:
        raise InputError(
            f"The poses contradict the photographs: motions between images are {np.degrees(own):.2g} degrees off on "
            f"average, and {np.degrees(best):.2g} if {reading.words}. Correct the file."
        )
    rng, rows = np.random.default_rng(0), np.arange(len(centers))
    if len(rows) < GATES.fewest:
        return
    orders = [rng.permutation(rows) for _ in range(GATES.shuffles)]
    fitting = sum(score(Reading("", rotation[order], centers[order]), motions) <= own for order in orders)
    if fitting > NORMAL.significance * GATES.shuffles:
        raise InputError(
            f"The poses contradict the photographs: motions between images are {np.degrees(own):.2g} degrees off on "
            f"average, and no more so in {fitting} of {GATES.shuffles} random orders of the poses. Check that names "
            "and poses belong together."
        )


def score(reading: Reading, motions: Motions) -> float:
    """Return the deviation of motions from a reading, radians: the mean of rotations and directions, each truncated."""
    first, second = motions.first, motions.second
    between = reading.rotation[second] @ np.swapaxes(reading.rotation[first], 1, 2)
    off = np.einsum("nij,nij->n", between, quaternion.to_matrix(motions.rotation))
    turn = np.arccos(np.clip((off - 1.0) / 2.0, -1.0, 1.0))
    way = reading.centers[first] - reading.centers[second]
    way = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
    seen = np.einsum("nij,nj->ni", reading.rotation[second], way)
    swing = np.arccos(np.clip(np.einsum("ni,ni->n", seen, motions.direction), -1.0, 1.0))
    parts = (turn, swing[motions.direction_sigma < GATES.cut / 4])
    return float(np.mean([np.mean(_best(np.minimum(part, GATES.cut))) for part in parts if len(part)]))


def _best(values: FloatArray) -> FloatArray:
    """Return the smallest values, without those that gross errors may have made."""
    return np.sort(values)[: max(1, int(GATES.kept * len(values)))]


def readings(rotation: FloatArray, centers: FloatArray) -> Iterator[Reading]:
    """Yield the other ways to read poses: inverse, cameras with other axes, mirrored, places with other axes."""
    inverse, moved = np.swapaxes(rotation, 1, 2), -np.einsum("nij,nj->ni", rotation, centers)
    ways = ((rotation, centers, ""), (inverse, moved, "they are inverted (world to camera for camera to world) and "))
    for turned, places, words in ways:
        if words:
            yield Reading(words.removesuffix(" and "), turned, places)
        for axes in _signed_permutations():
            if np.linalg.det(axes) > 0.0 and not np.array_equal(axes, np.eye(3)):
                yield Reading(words + _camera_words(axes), axes @ turned, places)
    for mirror in np.eye(3):
        reflection = np.eye(3) - 2.0 * np.outer(mirror, mirror)
        for axes in _signed_permutations():
            if np.linalg.det(axes) < 0.0:
                yield Reading(
                    "their axes are left-handed, as in Unity and Unreal",
                    axes @ rotation @ reflection,
                    centers @ reflection,
                )
    for axes in _signed_permutations():
        if not np.array_equal(axes, np.eye(3)):
            yield Reading(_place_words(axes), rotation, centers @ axes.T)
    for order, words in (((0, 1), "latitudes and longitudes"), ((1, 0), "longitudes and latitudes")):
        latitude, longitude = centers[:, order[0]], centers[:, order[1]]
        if np.abs(latitude).max() <= 90.0 and np.abs(longitude).max() <= 180.0:
            east = np.cos(np.radians(np.median(latitude))) * longitude
            yield Reading(
                f"the places are {words} in degrees with heights in metres; pass metres to the east, north and up",
                rotation,
                np.stack([_DEGREE * east, _DEGREE * latitude, centers[:, 2]], axis=1),
            )


def _signed_permutations() -> Iterator[FloatArray]:
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            yield np.diag(signs) @ np.eye(3)[list(order)]


def _camera_words(axes: FloatArray) -> str:
    if np.array_equal(axes, np.diag([1.0, -1.0, -1.0])):
        return "the cameras have y up and look along -z where y down and z are expected, or vice versa (OpenGL, OpenCV)"
    return f"the axes of the cameras, x right, y down, z forward, are {_listed(axes)} of the file"


def _place_words(axes: FloatArray) -> str:
    if np.array_equal(np.abs(axes), np.eye(3)[[1, 0, 2]]) and np.linalg.det(axes) < 0.0:
        return "x and y of the places are exchanged (east and north, latitude and longitude)"
    return f"the places have the axes {_listed(axes)} of the file, which its rotations have not"


def _listed(axes: FloatArray) -> str:
    words = ("x", "y", "z")
    return ", ".join(
        ("-" if row[int(np.abs(row).argmax())] < 0 else "") + words[int(np.abs(row).argmax())] for row in axes
    )
