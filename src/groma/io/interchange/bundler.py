# SPDX-License-Identifier: BSD-3-Clause
r"""Reconstructions of Bundler: ``bundle.out`` (v0.3) and, beside it, the list of its images, ``list.txt``.

After ``# Bundle file v0.3`` and the counts of cameras and points there are, for each camera, ``f k1 k2``, a rotation
matrix R and a translation t; for each point its place, its colour and its views ``n (image feature u v)``. Cameras look
along their negative z axis with y up. With :math:`D = \mathrm{diag}(1, -1, -1)`

.. math::
    R_{cw} = D R, \qquad t_{cw} = D t, \qquad
    (u, -v) = f\,(1 + k_1 s + k_2 s^2)\,(x/z, y/z), \quad s = (x^2 + y^2)/z^2

Pixels count from the image centre, with v up; where the photographs are at hand their size moves them to the corner
(:mod:`groma.io.interchange.centred`). Cameras with f = 0 were not reconstructed and are left out.

Reference: N. Snavely, *Bundler v0.4 User's Manual*, 2008.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import numpy as np

from groma.bounded.content import read_content
from groma.bounded.names import existing
from groma.bounded.text import read_lines, shown
from groma.errors import FileFormatError
from groma.io.interchange.calibration import Calibration
from groma.io.interchange.centred import centred_scene, point_rows
from groma.io.interchange.poses import file_in, rigid, size_of_image
from groma.io.pose_conventions import BUNDLER
from groma.io.reading import reading
from groma.io.registry import SceneFormat, register_format
from groma.scene import Scene

_NAME = "bundle.out"
#: The list of RunBundler.sh; its names begin one folder up, like the bundle file's.
_PREPARED = "prepare/list.txt"
_FIRST_LINE = b"# Bundle file v0.3"
#: Numbers of a camera (file format).
_CAMERA = 15


def read_bundler(path: str | os.PathLike[str]) -> Scene:
    """Read a bundle file; images are named by ``list.txt`` beside it, else, with a warning, by their numbers.

    Parameters
    ----------
    path : path
        The bundle file, or its folder. The list is ``list.txt`` there, one folder up or in ``prepare`` there, or, for
        ``NAME.out``, ``NAME.list.txt`` or ``NAME.txt``.

    Raises
    ------
    FileFormatError
        If counts, numbers or references are not those of a bundle file, or the list has another number of images.
    """
    place = file_in(existing(path), _NAME)
    with reading(place, "bundle file"):
        first, _, body = read_content(place).partition(b"\n")
        if first.strip() != _FIRST_LINE:
            raise FileFormatError(f"{place} must begin with {_FIRST_LINE.decode()!r}; it begins with {shown(first)}.")
        num_cameras, num_points = _counts(body, place)
        numbers = np.fromstring(body.decode("ascii"), sep=" ")[2:]
        if len(numbers) < _CAMERA * num_cameras:
            raise FileFormatError(
                f"{place} promises {num_cameras} cameras, {_CAMERA * num_cameras} numbers; it has {len(numbers)}. "
                "Fetch it again."
            )
        if not np.isfinite(numbers).all():
            raise FileFormatError(f"{place} holds a number that is not finite. Correct the file.")
        cameras, rest = np.split(numbers, [_CAMERA * num_cameras])
        cameras = cameras.reshape(-1, _CAMERA)
        rows = point_rows(rest, num_points, place)
        folder, names = _names(place, num_cameras)
        posed = np.flatnonzero(cameras[:, 0] != 0.0)
        used = cameras[posed]
        poses = rigid(used[:, 3:12].reshape(-1, 3, 3), used[:, 12:], place, BUNDLER)
        calibrations = [
            _calibration(tuple(lens), size_of_image(folder, names[row]))
            for row, lens in zip(posed.tolist(), used[:, :3].tolist(), strict=True)
        ]
        rows.pixel[:, 1] *= -1.0
        scene = centred_scene(names, calibrations, poses, posed, rows, place)
    if names and _list(place) is None:
        warnings.warn(
            f"{place} has no list of its images beside it (list.txt, one name a line): they are named by their "
            f"numbers, {names[0]} and so on.",
            stacklevel=2,
        )
    return scene


def _counts(body: bytes, path: Path) -> tuple[int, int]:
    words = body[:100].split(None, 2)[:2]
    if len(words) < 2 or not all(word.isdigit() and len(word) < 12 for word in words):
        raise FileFormatError(f"{path} must say how many cameras and points it has; got {shown(body[:40])}.")
    cameras, points = int(words[0]), int(words[1])
    if 2 * (_CAMERA * cameras + 7 * points) > len(body):
        raise FileFormatError(f"{path} promises {cameras} cameras and {points} points in {len(body)} characters.")
    return cameras, points


def _list(path: Path) -> Path | None:
    """Return the list of the images of a bundle file, if there is one."""
    beside = [path.with_name("list.txt"), path.with_suffix(".list.txt"), path.with_suffix(".txt")]
    above = path.absolute().parent.parent
    return next((place for place in [*beside, above / "list.txt", above / _PREPARED] if place.is_file()), None)


def _names(path: Path, count: int) -> tuple[Path, list[str]]:
    """Return the folder of the images, and their names: the first word of each line of the list."""
    found = _list(path)
    if found is None:
        return path.parent, [f"{row:08d}.jpg" for row in range(count)]
    names = [line.split()[0] for _, line in read_lines(found)]
    if len(names) != count:
        raise FileFormatError(f"{found} should name {count} images, one a line, as {path.name} has; got {len(names)}.")
    folder = found.parents[1] if found == path.absolute().parents[1] / _PREPARED else found.parent
    return folder, [os.path.normpath(name).replace(os.sep, "/") for name in names]


def _calibration(lens: tuple[float, float, float], size: tuple[int, int]) -> Calibration:
    focal, k1, k2 = lens
    if size == (0, 0):
        return Calibration("BAL", (focal, k1, k2))
    return Calibration("RADIAL", (focal, size[0] / 2, size[1] / 2, k1, k2), size)


register_format(
    SceneFormat(
        "bundler",
        source="a Bundler file (bundle.out)",
        recognise=lambda path, head: (path / _NAME).is_file() if path.is_dir() else head.startswith(_FIRST_LINE),
        read=read_bundler,
    )
)
