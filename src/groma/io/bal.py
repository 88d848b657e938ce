# SPDX-License-Identifier: BSD-3-Clause
r"""Files of *Bundle Adjustment in the Large* (BAL), plain or compressed with bzip2 or gzip.

The text holds ``cameras points observations``, one line ``camera point u v`` per observation, nine numbers per camera
(angle-axis rotation, translation, f, k1, k2) and three per point. BAL cameras look along their negative z axis with
y up; scenes here look along positive z with y down. With :math:`D = \mathrm{diag}(1, -1, -1)`

.. math:: R = D R_{BAL}, \qquad t = D t_{BAL}, \qquad (u, v) = (u_{BAL}, -v_{BAL}),

and the world stays as it is. Pixels count from the image centre; the image size is not known.

Reference: S. Agarwal, N. Snavely, S. Seitz, R. Szeliski, *Bundle Adjustment in the Large*, 2010.
"""

from __future__ import annotations

import bz2
import gzip
import io
import os
import sys
from pathlib import Path

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.bounded.content import read_content
from groma.bounded.names import existing
from groma.errors import FileFormatError, InputError, OutputError
from groma.geometry import quaternion
from groma.io.atomic import atomic_output
from groma.io.pose_conventions import BAL, FLIP
from groma.io.reading import reading
from groma.io.registry import HEAD_BYTES, SceneFormat, register_format
from groma.scene import Cameras, PointObservations, Points, Scene
from groma.scene.checks import check_scene_given

#: The rotation by pi about x, which is :data:`FLIP`.
_FLIP_QUATERNION = np.array([1.0, 0.0, 0.0, 0.0])
_KIND = "BAL file"


def read_bal(path: str | os.PathLike[str]) -> Scene:
    """Read a BAL file; each camera becomes an image with its own calibration of model ``BAL``.

    Parameters
    ----------
    path : path
        Plain text, .bz2 or .gz, recognised by content.

    Raises
    ------
    FileFormatError
        If counts, indices or numbers are not those of a BAL file.
    """
    place = existing(path)
    with reading(place, _KIND):
        (num_cameras, num_points, num_observations), body = _split(read_content(place), place)
        wanted = 4 * num_observations + 9 * num_cameras + 3 * num_points
        # Every number takes a character and a separator: refuse impossible counts before memory is taken for them.
        if 2 * wanted - 1 > len(body):
            raise FileFormatError(
                f"{place} promises {num_cameras} cameras, {num_points} points and {num_observations} observations, "
                f"which is {wanted} numbers, but holds only {len(body)} more characters. Fetch it again."
            )
        numbers = np.fromstring(body, sep=" ") if not body.isspace() and body else np.zeros(0)
        if len(numbers) != wanted:
            raise FileFormatError(f"{place} should hold {wanted} numbers after its first line; got {len(numbers)}.")
        if not np.isfinite(numbers).all():
            first = int(np.flatnonzero(~np.isfinite(numbers))[0])
            raise FileFormatError(f"{place}: number {first + 1} after the first line is {numbers[first]}, not finite.")
        observations, rest = np.split(numbers, [4 * num_observations])
        observations = observations.reshape(-1, 4)
        camera_params, xyz = np.split(rest, [9 * num_cameras])
        index = [
            _index(observations[:, 0], num_cameras, "camera", place),
            _index(observations[:, 1], num_points, "point", place),
        ]
        return _scene(index[0], index[1], observations[:, 2:], camera_params.reshape(-1, 9), xyz.reshape(-1, 3).copy())


def write_bal(scene: Scene, path: str | os.PathLike[str], force: bool = False) -> None:
    """Write the points of a scene as a BAL file, compressed if the name ends in .bz2 or .gz.

    Raises
    ------
    InputError
        If the scene holds lines or planes, or cameras that the BAL model cannot express (see :func:`bal_params`).
    """
    check_scene_given(scene)
    params, principal_point = check_bal(scene)
    seen = scene.point_observations
    pixel = (seen.pixel - principal_point[seen.image_idx]) * [1, -1]
    poses = scene.cam_from_world
    rotation = quaternion.log(quaternion.multiply(_FLIP_QUATERNION, poses[:, :4]))
    numbers = np.hstack([rotation, poses[:, 4:] * FLIP, params]).ravel().tolist() + scene.points.xyz.ravel().tolist()
    text = io.StringIO()
    text.write(f"{scene.num_images} {scene.num_points} {len(seen)}\n")
    rows = zip(seen.image_idx.tolist(), seen.point_idx.tolist(), *pixel.T.tolist(), strict=True)
    text.writelines(f"{camera} {point} {u!r} {v!r}\n" for camera, point, u, v in rows)
    text.writelines(f"{number!r}\n" for number in numbers)
    content = text.getvalue().encode()
    suffix = Path(path).suffix.lower()
    if suffix == ".bz2":
        content = bz2.compress(content)
    elif suffix == ".gz":
        _refuse_broken_zlib()
        content = gzip.compress(content, mtime=0)
    with atomic_output(path, force) as draft:
        draft.write_bytes(content)


def check_bal(scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Return what :func:`bal_params` does, if a BAL file can hold the scene.

    Raises
    ------
    InputError
        If the scene holds lines or planes, or cameras that the BAL model cannot express.
    """
    if scene.num_lines or scene.num_planes or scene.num_directions:
        raise InputError(
            f"A BAL file holds points only; the scene has {scene.num_lines} lines, {scene.num_planes} planes and "
            f"{scene.num_directions} directions. Write a groma archive (.npz), or scene.points_only()."
        )
    return bal_params(scene)


def bal_params(scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Return (f, k1, k2) and the principal point of every image, (N, 3) and (N, 2), where the BAL model can hold them.

    Raises
    ------
    InputError
        If a camera has two focal lengths that differ, or other distortion than k1 and k2.
    """
    # Where f, cx, cy, k1 and k2 stand among the parameters; -1: not there.
    places = {
        "BAL": (0, -1, -1, 1, 2),
        "SIMPLE_PINHOLE": (0, 1, 2, -1, -1),
        "PINHOLE": (0, 2, 3, -1, -1),
        "SIMPLE_RADIAL": (0, 1, 2, 3, -1),
        "RADIAL": (0, 1, 2, 3, 4),
    }
    values = np.zeros((scene.num_cameras, 5))
    for row, name in enumerate(scene.cameras.models):
        params = np.append(scene.cameras.params_of(row), 0.0)
        if name not in places or (name == "PINHOLE" and params[0] != params[1]):
            raise InputError(
                f"A BAL file holds one focal length, k1 and k2 per camera; camera {scene.cameras.ids[row]} has model "
                f"{name} {params[:-1].tolist()}. Write a COLMAP model or a groma archive instead."
            )
        values[row] = params[list(places[name])]
    values = values[scene.images.camera_idx]
    return values[:, [0, 3, 4]], values[:, 1:3]


def looks_like_bal(head: bytes) -> bool:
    """Tell from the first bytes of a file, decompressed where needed, whether its first line holds three counts.

    More numbers in it are a pose; so are three before a row of a matrix, where BAL has two indices and a pixel.
    """
    first, second = (line.split(None, 3) for line in ([*head.lstrip().splitlines(), b"", b""])[:2])
    counts = len(first) == 3 and all(word.isdigit() for word in first)
    return counts and all(word.isdigit() for word in second[:2])


def _recognise(path: Path, head: bytes) -> bool:
    """Whether a file, possibly compressed, starts with three counts."""
    try:
        for magic, module in ((b"BZh", bz2), (b"\x1f\x8b", gzip)):
            if head.startswith(magic):
                with module.open(path) as stream:
                    return looks_like_bal(stream.read(HEAD_BYTES))
    except Exception as error:  # OSError, EOFError, ValueError, and zlib.error, which derives from none of them
        raise FileFormatError(f"{path} cannot be decompressed: {error}. Fetch it again.") from error
    return looks_like_bal(head)


def _refuse_broken_zlib() -> None:
    """Raise where compressing would end the process: see :mod:`groma.io.archive` on pycolmap and zlib."""
    loaded = list(sys.modules)
    if "pycolmap" in loaded and "zlib" in loaded and loaded.index("pycolmap") < loaded.index("zlib"):
        raise OutputError(
            "Cannot write .gz: pycolmap was imported before zlib, which breaks zlib in this process. Import groma.io "
            "(or zlib) before pycolmap, or write .bz2 or plain text."
        )


def _split(text: bytes, path: Path) -> tuple[list[int], bytes]:
    head = text[:200].split(None, 3)[:3]
    if len(head) < 3 or not all(word.isdigit() and len(word) <= 15 for word in head):
        raise FileFormatError(
            f"{path} must begin with three counts (cameras, points, observations); it begins with {text[:40]!r}."
        )
    end = 0
    for word in head:
        end = text.index(word, end) + len(word)
    return [int(word) for word in head], text[end:]


def _index(values: FloatArray, size: int, noun: str, path: Path) -> IntArray:
    good = (values >= 0) & (values < size) & (values == np.floor(values))
    if not good.all():
        row = int(np.flatnonzero(~good)[0])
        raise FileFormatError(f"{path}: observation {row} names {noun} {values[row]:g}, but there are {size} {noun}s.")
    return values.astype(np.int64)


def _scene(image_idx: IntArray, point_idx: IntArray, pixel: FloatArray, camera: FloatArray, xyz: FloatArray) -> Scene:
    count = len(camera)
    angle = np.linalg.norm(camera[:, :3], axis=1) if count else np.zeros(0)
    if count and angle.max() > 1e6:
        raise FileFormatError(
            f"Camera {int(angle.argmax())} is turned by {angle.max():.3g} rad; not a rotation vector."
        )
    poses = BAL.cam_from_world(camera[:, :3], camera[:, 3:6])
    poses[:, :4] /= np.linalg.norm(poses[:, :4], axis=1, keepdims=True)
    return Scene.from_images(
        Cameras.of(np.arange(count) + 1, ["BAL"] * count, list(camera[:, 6:]), np.zeros((count, 2))),
        [f"{index:05d}" for index in range(count)],
        np.arange(count),
        poses,
        points=Points.at(xyz),
        point_observations=PointObservations.numbered(image_idx, point_idx, pixel * [1, -1]),
    )


register_format(
    SceneFormat(
        "bal",
        source="a BAL file (three counts in its first line)",
        target=".txt, .bz2 or .gz for BAL",
        endings=(".txt", ".bz2", ".gz"),
        recognise=_recognise,
        read=read_bal,
        write=write_bal,
        check=check_bal,
    )
)
