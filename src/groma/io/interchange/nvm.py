# SPDX-License-Identifier: BSD-3-Clause
r"""Reconstructions of VisualSFM: ``.nvm`` (N-View Match, version 3).

After ``NVM_V3`` a file lists models: the number of cameras, for each ``name f qw qx qy qz`` and the
camera centre, ``r 0``; the number of points, for each its place, its colour and its views ``n (image feature u v)``.
A model with no cameras ends the list. Cameras look along z with y down, as ours. Pixels count from the image centre
(:mod:`groma.io.interchange.centred`), or from the principal point after ``FixedK fx cx fy cy`` in the first line.

The distortion goes from the measured pixel to the ray, with r for pixels divided by the focal length:

.. math:: (x/z, y/z) = (1 + r\,\|m\|^2)\, m, \qquad m = (u, v)/f

which :func:`groma.io.interchange.calibration.inverse_polynomial` turns round. ``NVM_V3_R9T`` has a rotation matrix and
a translation in place of quaternion and centre.

Reference: C. Wu, *VisualSFM: a visual structure from motion system*, 2011, and the documentation of *Multicore bundle
adjustment*.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from groma._typing import FloatArray
from groma.bounded.names import existing
from groma.bounded.text import finite, read_text, shown, whole
from groma.errors import FileFormatError
from groma.io.interchange.calibration import Calibration, inverse_polynomial
from groma.io.interchange.centred import PointRows, centred_scene, point_rows
from groma.io.interchange.poses import rigid, size_of_image
from groma.io.pose_conventions import NVM, NVM_MATRIX
from groma.io.reading import reading, warn_of_the_others
from groma.io.registry import SceneFormat, register_format
from groma.scene import Scene


@dataclass(frozen=True, eq=False)
class _Model:
    """One model of a file, as it stands there."""

    names: list[str]
    #: (N, 1 + 4 + 3 + 1), or with a matrix (N, 1 + 9 + 3 + 1): focal length, rotation, place, distortion.
    cameras: FloatArray
    rows: PointRows


def read_nvm(path: str | os.PathLike[str]) -> Scene:
    """Read an NVM file; of several models the one with most cameras, with a warning.

    Raises
    ------
    FileFormatError
        If counts, numbers or references are not those of an NVM file, or a distortion is too strong to be turned round.
    """
    place = existing(path)
    with reading(place, "NVM file"):
        lines = [line for line in map(str.strip, read_text(place).splitlines()) if line and not line.startswith("#")]
        words = lines[0].split() if lines else []
        if not words or not words[0].startswith("NVM_V3"):
            raise FileFormatError(f"{place} must begin with NVM_V3; it begins with {shown(''.join(lines[:1]))}.")
        fixed = finite(words[2:6], place, "fx cx fy cy after FixedK") if words[1:2] == ["FixedK"] else []
        if len(fixed) not in (0, 4):
            raise FileFormatError(f"{place}: expected fx cx fy cy after FixedK; got {len(fixed)} numbers.")
        turn = 9 if "R9T" in words[0] else 4
        models, at = [], 1
        while at < len(lines) and (count := whole(lines[at].split()[0], place, "a number of cameras")) > 0:
            model, at = _model(lines, at + 1, count, turn, place)
            models.append(model)
        if not models:
            raise FileFormatError(f"{place} has no cameras. Is it a file of matches, saved before reconstruction?")
        scene = _scene(max(models, key=lambda one: len(one.names)), turn, fixed, place)
    warn_of_the_others(place, [len(one.names) for one in models])
    return scene


def _model(lines: list[str], at: int, count: int, turn: int, path: Path) -> tuple[_Model, int]:
    """Return the model whose cameras start at a line, and the line after it."""
    if at + count >= len(lines):
        raise FileFormatError(f"{path} promises {count} cameras, but ends before its points. Fetch or save it again.")
    names, numbers = [], []
    for number, line in enumerate(lines[at : at + count], 1):
        # Names may have spaces; numbers follow a tab, or are the last words of the line.
        name, tab, rest = line.partition("\t")
        words = rest.split() if tab else line.split()[-(turn + 6) :]
        name = name if tab else " ".join(line.split()[: -(turn + 6)])
        if len(words) not in (turn + 5, turn + 6) or not name:
            raise FileFormatError(
                f"{path}, camera {number}: expected a name and {turn + 6} numbers; got {shown(line)}."
            )
        names.append(name.strip('"').replace("\\", "/"))
        numbers.append(finite(words[: turn + 5], f"{path}, camera {number}"))
    at += count
    num_points = whole(lines[at], path, "a number of points")
    if not 0 <= num_points <= len(lines) - at - 1:
        raise FileFormatError(
            f"{path} promises {num_points} points, one a line; it has {len(lines) - at - 1} lines more."
        )
    at += 1
    body = " ".join(lines[at : at + num_points])
    found = np.fromstring(body, sep=" ") if body else np.zeros(0)
    if not np.isfinite(found).all():
        raise FileFormatError(f"{path} holds a number that is not finite. Correct the file.")
    rows = point_rows(found, num_points, path)
    return _Model(names, np.array(numbers).reshape(count, turn + 5), rows), at + num_points


def _scene(model: _Model, turn: int, fixed: list[float], path: Path) -> Scene:
    cameras, rows = model.cameras, model.rows
    sizes = [size_of_image(path.parent, name) for name in model.names]
    if fixed:
        lenses = [_fixed_camera(fixed, size) for size in sizes]
        rows.pixel[:] += _from_principal_point(fixed, sizes, rows)
    else:
        reach = _reach(cameras[:, 0], sizes, rows, path)
        lenses = [
            inverse_polynomial(focal, (size[0] / 2, size[1] / 2), distortion, radius, size)
            for focal, distortion, size, radius in zip(
                cameras[:, 0].tolist(), cameras[:, 4 + turn].tolist(), sizes, reach.tolist(), strict=True
            )
        ]
    poses = _poses(cameras[:, 1 : 1 + turn], cameras[:, 1 + turn : 4 + turn], path)
    return centred_scene(model.names, lenses, poses, np.arange(len(sizes)), rows, path)


def _poses(rotation: FloatArray, last: FloatArray, path: Path) -> FloatArray:
    """Return poses of matrices and translations, or of quaternions and centres."""
    if rotation.shape[1] == 9:
        return rigid(rotation.reshape(-1, 3, 3), last, path, NVM_MATRIX)
    length = np.linalg.norm(rotation, axis=1, keepdims=True)
    if not ((length > 1e-3) & (length < 1e3)).all() or np.abs(last).max() > 1e100:
        raise FileFormatError(f"{path}: expected quaternions of length 1 and finite centres. Correct the file.")
    return NVM.cam_from_world(rotation / length, last)


def _reach(focal: FloatArray, sizes: list[tuple[int, int]], rows: PointRows, path: Path) -> FloatArray:
    """Return the radius (N,) of each image that is used, in focal lengths: to its corners, or to its observations."""
    if not (focal > 0.0).all():
        raise FileFormatError(f"{path}: expected positive focal lengths; got {focal.min():g}. Correct the file.")
    radius = np.linalg.norm(np.array(sizes, float), axis=1) / 2
    inside = (rows.image_idx >= 0) & (rows.image_idx < len(sizes))
    np.maximum.at(radius, rows.image_idx[inside], np.linalg.norm(rows.pixel[inside], axis=1))
    return radius / focal


def _fixed_camera(fixed: list[float], size: tuple[int, int]) -> Calibration:
    """Return the camera of a fixed calibration, which has no distortion; without a size its principal point is 0, 0."""
    focal_x, center_x, focal_y, center_y = fixed
    center = (center_x, center_y) if size != (0, 0) else (0.0, 0.0)
    return Calibration("PINHOLE", (focal_x, focal_y, *center), size)


def _from_principal_point(fixed: list[float], sizes: list[tuple[int, int]], rows: PointRows) -> FloatArray:
    """Return how far the principal point of a fixed calibration lies from the image centre, for every observation."""
    offset = np.array([[fixed[1] - w / 2, fixed[3] - h / 2] if w else [0.0, 0.0] for w, h in sizes])
    inside = (rows.image_idx >= 0) & (rows.image_idx < len(sizes))
    return np.where(inside[:, None], offset[np.where(inside, rows.image_idx, 0)], 0.0)


register_format(
    SceneFormat(
        "nvm", source="a VisualSFM file (.nvm)", recognise=lambda path, head: head.startswith(b"NVM_V3"), read=read_nvm
    )
)
