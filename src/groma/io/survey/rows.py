# SPDX-License-Identifier: BSD-3-Clause
"""Text files of measurements: one a line, separated by commas, semicolons or white space; ``#`` begins a comment.

====================  ============================================================================================
distances             ``name name distance [sigma]``
known planes          ``name nx ny nz w [sigma]``, for n.X + w = 0; or ``name z 12.3 [sigma]``: its coordinate x, y
                      or z is known
known directions      ``name x y z [sigma]`` or ``name vertical [sigma]``, degrees: of a photograph where down is in
                      the axes of its camera (x right, y down, z forward), of a landmark its direction in the world.
                      ``name x y z sigma X Y Z``: the photograph sees the direction X Y Z of the world there
poses                 ``name x y z qx qy qz qw``, world from camera as in TUM's trajectories; after it nothing, or
                      standard deviations of position and orientation (degrees), or the covariance of x, y, z and of
                      turns about the axes of the world (radians): 21 numbers, its upper triangle by rows, or all 36
====================  ============================================================================================

Names are those of photographs and control points; landmarks are ``line:5``, ``plane:2``, ``point:17``,
``direction:1`` by their identifiers.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray
from groma.bounded.names import existing
from groma.bounded.text import finite, is_number, read_lines, shown
from groma.errors import FileFormatError
from groma.io.reading import reading
from groma.io.survey.positions import split

_NAN = float("nan")
#: Numbers beyond are damaged.
_LARGEST = 1e50
_AXES = {"x": 0, "y": 1, "z": 2, "height": 2}


@dataclass(frozen=True, eq=False)
class DistancesFile:
    """Distances as a file holds them."""

    #: (N,) names of what each is between.
    first: tuple[str, ...]
    second: tuple[str, ...]
    #: (N,) distance and its standard deviation, NaN: not in the file.
    distance: FloatArray
    sigma: FloatArray
    #: Where they come from, for messages.
    source: str


@dataclass(frozen=True, eq=False)
class PlanesFile:
    """Known planes as a file holds them."""

    #: (N,) names of the objects on each.
    names: tuple[str, ...]
    #: (N, 4) unit normals and offsets.
    hesse: FloatArray
    #: (N,) standard deviations, NaN: not in the file.
    sigma: FloatArray
    source: str


@dataclass(frozen=True, eq=False)
class DirectionsFile:
    """Known directions as a file holds them."""

    #: (N,) names of what has each.
    names: tuple[str, ...]
    #: (N, 3) unit vectors: of photographs in the camera, of landmarks in the world.
    vectors: FloatArray
    #: (N, 3) the same direction as a unit vector of the world; down by default.
    in_world: FloatArray
    #: (N,) standard deviations, degrees, NaN: not in the file.
    sigma_deg: FloatArray
    source: str


@dataclass(frozen=True, eq=False)
class PosesFile:
    """Measured poses as a file holds them."""

    #: (N,) names of images.
    names: tuple[str, ...]
    #: (N, 7) position of the camera and orientation world from camera, [x y z qx qy qz qw].
    world_from_cam: FloatArray
    #: (N, 6, 6) covariance of position and of turns about the axes of the world (radians); NaN where the file says
    #: nothing.
    covariance: FloatArray
    source: str


def read_distances(path: str | os.PathLike[str]) -> DistancesFile:
    """Read measured distances; see the module for the layout.

    Raises
    ------
    FileFormatError
        If a line is not of that form, or a distance is not positive.
    """
    found: list[tuple[str, str, float, float]] = []
    for where, words in _rows(path, "file of distances", "name name distance sigma", (3, 4), 2):
        numbers = _numbers(words[2:], where, "a distance and its standard deviation")
        if min(numbers) <= 0.0:
            raise FileFormatError(f"{where}: a distance and its standard deviation must be positive; got {numbers}.")
        found.append((words[0], words[1], numbers[0], numbers[1] if len(numbers) > 1 else _NAN))
    first, second, distance, sigma = zip(*found, strict=True)
    return DistancesFile(first, second, np.array(distance), np.array(sigma), str(path))


def read_known_planes(path: str | os.PathLike[str]) -> PlanesFile:
    """Read objects on known planes; see the module for the layout.

    Raises
    ------
    FileFormatError
        If a line is not of that form, or a normal is zero.
    """
    expected = "name nx ny nz w sigma, or name z value sigma"
    names, planes, sigmas = [], [], []
    for where, words in _rows(path, "file of known planes", expected, (3, 4, 5, 6), None):
        axis = _AXES.get(words[1].lower())
        if (axis is None and len(words) < 5) or (axis is not None and len(words) > 4):
            raise FileFormatError(f"{where}: expected {expected}; got {shown(' '.join(words))}.")
        numbers = _numbers(words[1 if axis is None else 2 :], where, "numbers of a plane")
        plane = np.array(numbers[:4]) if axis is None else np.append(np.eye(3)[axis], -numbers[0])
        rest = numbers[4:] if axis is None else numbers[1:]
        length = float(np.linalg.norm(plane[:3]))
        if length == 0.0:
            raise FileFormatError(f"{where}: the normal of a plane is not zero; got {plane[:3].tolist()}.")
        names.append(words[0])
        planes.append(plane / length)
        sigmas.append(_positive(rest, where))
    return PlanesFile(tuple(names), np.array(planes), np.array(sigmas), str(path))


def read_directions(path: str | os.PathLike[str]) -> DirectionsFile:
    """Read known directions; see the module for the layout.

    Raises
    ------
    FileFormatError
        If a line is not of that form, or a vector is zero.
    """
    expected = "name x y z sigma, or name vertical sigma"
    names, rows, sigmas = [], [], []
    for where, words in _rows(path, "file of directions", expected, (2, 3, 4, 5, 8), None):
        vertical = words[1].lower() == "vertical"
        if (len(words) > 3) if vertical else (len(words) < 4):
            raise FileFormatError(f"{where}: expected {expected}; got {shown(' '.join(words))}.")
        numbers = _numbers(words[2 if vertical else 1 :], where, "a direction and its standard deviation in degrees")
        numbers = [0.0, 0.0, -1.0, *numbers] if vertical else numbers
        vector, world = np.array(numbers[:3]), np.array(numbers[4:] or [0.0, 0.0, -1.0])
        if min(np.linalg.norm(vector), np.linalg.norm(world)) == 0.0:
            raise FileFormatError(f"{where}: a direction is not zero; got {shown(' '.join(words))}.")
        names.append(words[0])
        rows.append([vector / np.linalg.norm(vector), world / np.linalg.norm(world)])
        sigmas.append(_positive(numbers[3:4], where))
    vectors = np.array(rows)
    return DirectionsFile(tuple(names), vectors[:, 0], vectors[:, 1], np.array(sigmas), str(path))


def read_measured_poses(path: str | os.PathLike[str]) -> PosesFile:
    """Read measured poses with their covariances; see the module for the layout.

    Raises
    ------
    FileFormatError
        If a line is not of that form, a quaternion is not of unit length, or a covariance not positive definite.
    """
    expected = "name x y z qx qy qz qw, and two standard deviations or a covariance"
    poses: dict[str, list[float]] = {}
    covariances = []
    for where, words in _rows(path, "file of poses", expected, (8, 10, 29, 44), 1):
        numbers = _numbers(words[1:], where, expected)
        length = float(np.linalg.norm(numbers[3:7]))
        if abs(length - 1.0) > 1e-3:  # derived from four numbers of three decimals
            raise FileFormatError(f"{where}: expected a unit quaternion qx qy qz qw; its length is {length:.4g}.")
        if words[0] in poses:
            raise FileFormatError(f"{where}: {shown(words[0])} has a pose already. Leave one of the two out.")
        poses[words[0]] = [*numbers[:3], *(np.array(numbers[3:7]) / length)]
        covariances.append(_covariance(numbers[7:], where))
    return PosesFile(tuple(poses), np.array(list(poses.values())), np.array(covariances), str(path))


def is_measured_poses(line: str) -> bool:
    """Tell from the first line of a file whether it holds poses by name, as :func:`read_measured_poses` reads them."""
    words = split(line)
    if len(words) not in (8, 10, 29, 44) or is_number(words[0]):
        return False
    return words[0].lower() == "name" or all(map(is_number, words[1:]))


def _covariance(numbers: list[float], where: str) -> FloatArray:
    if not numbers:
        return np.full((6, 6), np.nan)
    if len(numbers) == 2:
        if min(numbers) <= 0.0:
            raise FileFormatError(f"{where}: standard deviations must be positive; got {numbers}.")
        return np.diag([numbers[0] ** 2] * 3 + [np.radians(numbers[1]) ** 2] * 3)
    matrix = np.array(numbers).reshape(6, 6) if len(numbers) == 36 else np.zeros((6, 6))
    if len(numbers) == 21:
        matrix[np.triu_indices(6)] = numbers
        matrix = matrix + np.triu(matrix, 1).T
    size = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    if not size.all() or np.abs(matrix - matrix.T).max() > 1e-6 * np.abs(matrix).max():
        raise FileFormatError(f"{where}: the covariance is not symmetric with a positive diagonal. Correct the file.")
    if np.linalg.eigvalsh(matrix / size / size[:, None])[0] <= 1e-12:
        raise FileFormatError(f"{where}: the covariance is not positive definite. Give what is not known a large one.")
    return matrix


def _numbers(words: Sequence[str], where: str, expected: str) -> list[float]:
    """Return words as numbers of which squares can be computed with."""
    numbers = finite(words, where, expected)
    if max(map(abs, numbers), default=0.0) > _LARGEST:
        raise FileFormatError(f"{where}: {max(numbers, key=abs):g} is no measurement. Correct the file.")
    return numbers


def _positive(numbers: Sequence[float], where: str) -> float:
    """Return the standard deviation that may follow."""
    if not numbers:
        return _NAN
    if numbers[0] <= 0.0:
        raise FileFormatError(f"{where}: a standard deviation must be positive; got {numbers[0]:g}.")
    return numbers[0]


def _rows(
    path: str | os.PathLike[str], kind: str, expected: str, lengths: tuple[int, ...], number: int | None
) -> Iterator[tuple[str, list[str]]]:
    """Yield where a line is and its words.

    A first line that begins with ``name``, or has no number in column
    ``number``, is a header.
    """
    place, count = existing(path), 0
    with reading(place, kind):
        for row, (line_number, line) in enumerate(read_lines(place)):
            where, words = f"{place}, line {line_number}", split(line)
            if len(words) not in lengths:
                raise FileFormatError(f"{where}: expected {expected}; got {shown(line)}.")
            named = words[0].lower() in ("name", "image", "object")
            if row == 0 and (named or (number is not None and not is_number(words[number]))):
                continue
            count += 1
            yield where, words
    if not count:
        raise FileFormatError(f"{place} is a {kind} with nothing in it. Expected lines of {expected}.")
