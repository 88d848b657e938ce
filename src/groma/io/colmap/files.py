# SPDX-License-Identifier: BSD-3-Clause
"""The files of a COLMAP model: where they lie, and whether the binary ones hold as much as their counts promise.

pycolmap 4.2 reports inconsistent models by exceptions, but trusts the counts in binary files: a damaged count makes
it read zeros past the end of the file for hours while memory grows, and a truncated file can pass as a short model
(found by mutating a small model 300 times: 18 endless reads, 1 allocation failure, no abort; text models: none).
Walking over the counts costs milliseconds and makes the reader safe. Nothing but the 2D points is interpreted here.
"""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from groma.bounded.names import IMAGES, existing
from groma.errors import FileFormatError

_FILES = ("cameras", "images", "points3D")
_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<Ii")
_INT = struct.Struct("<I")
#: A 2D point of an image: pixel, and identifier of the point in space.
POINT = np.dtype([("xy", "<f8", 2), ("point", "<u8")])


def find_model(path: str | os.PathLike[str]) -> tuple[Path, Literal["binary", "text"]]:
    """Return the folder of the model at ``path``, ``path/sparse``, ``path/sparse/0`` or ``path/0``, and its form.

    Of several numbered models, as COLMAP makes them where photographs do not hang together, it is the one with most
    images.

    Raises
    ------
    FileFormatError
        If none of them holds a complete model.
    """
    root = existing(path)
    for place in (root, root / "sparse", *list(models_in_parts(root))[:1]):
        form = _form(place)
        if form is not None:
            return place, form
    raise FileFormatError(
        f"{root} holds no COLMAP model: expected cameras, images and points3D, all .bin or all .txt, there, in sparse, "
        f"in sparse/0 or in 0. {_remedy(root)}"
    )


def models_in_parts(root: Path) -> dict[Path, int]:
    """Return the models ``sparse/0``, ... or ``0``, ... of a folder with their numbers of images, the largest first."""
    found = {place: _num_images(place) for place in _parts(root) if _form(place) is not None}
    return dict(sorted(found.items(), key=lambda one: -one[1]))


def missing_from_parts(root: Path) -> str:
    """Say which files models ``sparse/0``, ... or ``0``, ... of a folder lack; empty where they are whole."""
    return _are_missing([f"{place.relative_to(root)}/{name}" for place in _parts(root) for name in _missing(place)])


def _parts(root: Path) -> list[Path]:
    numbered = [p for p in (*root.glob("sparse/[0-9]*"), *root.glob("[0-9]*")) if p.name.isdecimal()]
    return sorted(numbered, key=lambda p: (p.parent == root, int(p.name)))


def _missing(place: Path) -> list[str]:
    """Return the files that a model in a folder lacks; none where there is a whole one, or nothing of one."""
    lacking = [
        [f"{name}{end}" for name in _FILES if not (place / f"{name}{end}").is_file()] for end in (".bin", ".txt")
    ]
    fewest = min(lacking, key=len)
    return fewest if len(fewest) < len(_FILES) else []


def _are_missing(files: list[str]) -> str:
    return f"{', '.join(files)} {'is' if len(files) == 1 else 'are'} missing" if files else ""


def is_model(place: Path) -> bool:
    """Whether a folder holds a model, or a file is named like one of a model's."""
    if place.is_dir():
        return any(_form(part) is not None for part in (place, place / "sparse", *_parts(place)))
    return place.suffix in (".bin", ".txt") and place.stem in (*_FILES, "rigs", "frames")


def _form(place: Path) -> Literal["binary", "text"] | None:
    """Return the form of the model in a folder; None where there is none."""
    forms: tuple[tuple[str, Literal["binary", "text"]], ...] = ((".bin", "binary"), (".txt", "text"))
    return next((form for end, form in forms if all((place / f"{name}{end}").is_file() for name in _FILES)), None)


def _num_images(place: Path) -> int:
    """Return how many images a model promises, without reading it."""
    if _form(place) == "binary":
        with (place / "images.bin").open("rb") as file:
            head = file.read(_COUNT.size)
        return int(_COUNT.unpack(head)[0]) if len(head) == _COUNT.size else 0
    with (place / "images.txt").open("rb") as file:
        return sum(not line.startswith(b"#") for line in file) // 2


def _remedy(root: Path) -> str:
    """Say what to do with a folder without a model, by what else is in it."""
    names = sorted(entry.name for entry in root.iterdir()) if root.is_dir() else []
    archives = [name for name in names if name.lower().endswith(".npz") and not name.lower().endswith(".index.npz")]
    models = [
        name for name in names if (root / name / "cameras.bin").is_file() or (root / name / "cameras.txt").is_file()
    ]
    if missing := _are_missing(_missing(root)) or missing_from_parts(root):
        return f"{missing}: fetch or export it again."
    if archives or models:
        return f"It holds {', '.join((archives + models)[:3])}: pass {root / (archives + models)[0]}, for example."
    if any(name.lower().endswith(IMAGES) for name in names):
        return "It holds images: groma map makes a model of them."
    return "Check the path."


def check_binary_model(folder: Path, num_params: Mapping[int, int]) -> None:
    """Raise when a binary file of a model ends too early or too late.

    Parameters
    ----------
    folder : Path
        Folder with ``cameras.bin``, ``images.bin``, ``points3D.bin`` and perhaps ``rigs.bin`` and ``frames.bin``.
    num_params : mapping of int to int
        Number of parameters of each camera model, by COLMAP's number of the model.
    """
    walks = {
        "cameras.bin": lambda data: _walk_cameras(data, num_params),
        "images.bin": _walk_images,
        "points3D.bin": _walk_points,
        "rigs.bin": _walk_rigs,
        "frames.bin": _walk_frames,
    }
    for name, walk in walks.items():
        path = folder / name
        if not path.exists() and name in ("rigs.bin", "frames.bin"):
            continue  # models from before COLMAP 3.12
        data = path.read_bytes()
        try:
            end = walk(data)
        except (struct.error, IndexError) as error:
            raise FileFormatError(f"{path} is incomplete: it ends after {len(data)} bytes. Export it again.") from error
        except (OverflowError, ValueError) as error:
            raise FileFormatError(f"{path} is incomplete or damaged: {error}. Fetch or export it again.") from error
        if end != len(data):
            what = "ends too early" if end > len(data) else f"holds {len(data) - end} bytes too many"
            raise FileFormatError(f"{path} is damaged: it {what} for its counts. Fetch or export it again.")


def points_in_images(path: Path) -> dict[int, np.ndarray]:
    """Return the 2D points (n,) of each image of a checked ``images.bin`` by its identifier: ``xy`` and ``point``.

    pycolmap gives them one by one, which takes most of the time of reading a model.
    """
    return points_within(path.read_bytes())


def points_within(data: bytes | bytearray) -> dict[int, np.ndarray]:
    """Return the same of the content of such a file: views of its bytes."""
    at, found = 8, {}
    for _ in range(_COUNT.unpack_from(data)[0]):
        number = _INT.unpack_from(data, at)[0]
        at = data.find(b"\0", at + 64) + 1
        count = _COUNT.unpack_from(data, at)[0]
        found[number] = np.frombuffer(data, POINT, count, at + 8)
        at += 8 + POINT.itemsize * count
    return found


def check_text_rows(folder: Path, counts: Mapping[str, int]) -> None:
    """Raise unless the text files of a model have the given numbers of complete lines, comments aside."""
    for name, count in counts.items():
        content = (folder / name).read_bytes()
        found = sum(not line.startswith(b"#") for line in content.split(b"\n")[:-1])
        if found != count or not content.endswith(b"\n"):
            raise FileFormatError(f"{folder / name} is incomplete: it has {found} rows of {count}.")


def damage_in_text(folder: Path) -> str:
    """Return the place of a malformed row in the text files of a model, in words; "" if there is none.

    COLMAP's own reader names neither the file nor the line. Only the form of rows is checked.
    """
    rows = {
        "cameras.txt": lambda words: len(words) >= 4 and _numbers(words[:1] + words[2:]),
        "images.txt": lambda words: len(words) >= 10 and _numbers(words[:9]),
        "points3D.txt": lambda words: len(words) >= 8 and _numbers(words),
    }
    for name, is_row in rows.items():
        observations = False  # every second row of the images
        with (folder / name).open(encoding="utf-8", errors="replace") as file:
            for number, line in enumerate(file, 1):
                words = line.split()
                if observations:
                    good, observations = len(words) % 3 == 0 and _numbers(words), False
                elif not words or words[0].startswith("#"):
                    continue
                else:
                    good, observations = is_row(words), name == "images.txt"
                if not good:
                    return f"{name}, line {number}: {' '.join(words[:10])[:80]!r}"
    return ""


def _numbers(words: list[str]) -> bool:
    try:
        return all(math.isfinite(float(word)) for word in words)
    except ValueError:
        return False


def _count(data: bytes, least_row: int) -> int:
    """Return the count at the start; ValueError if the file is too short for it."""
    count = int(_COUNT.unpack_from(data)[0])
    if count * least_row > len(data):
        raise ValueError(f"it promises {count} entries in {len(data)} bytes")
    return count


def _walk_cameras(data: bytes, num_params: Mapping[int, int]) -> int:
    at = 8
    for _ in range(_count(data, 24)):
        model = _CAMERA.unpack_from(data, at)[1]
        if model not in num_params:
            raise ValueError(f"camera model number {model} is not known")
        at += 24 + 8 * num_params[model]
    return at


def _walk_images(data: bytes) -> int:
    at = 8
    for _ in range(_count(data, 73)):
        at = data.find(b"\0", at + 64) + 1  # id, pose, camera, name
        if at == 0:
            raise ValueError("it ends within an image name")
        at += 8 + 24 * _COUNT.unpack_from(data, at)[0]
    return at


def _walk_points(data: bytes) -> int:
    at = 8
    unpack = _COUNT.unpack_from
    for _ in range(_count(data, 51)):
        at += 51 + 8 * unpack(data, at + 43)[0]  # id, place, colour, error, track
    return at


def _walk_rigs(data: bytes) -> int:
    at = 8
    for _ in range(_count(data, 8)):
        sensors = _INT.unpack_from(data, at + 4)[0]
        at += 8 + (8 if sensors else 0)
        if sensors * 9 > len(data):
            raise ValueError(f"a rig promises {sensors} sensors")
        for _ in range(sensors - 1):
            at += 9 + (56 if data[at + 8] else 0)
    return at


def _walk_frames(data: bytes) -> int:
    at = 8
    for _ in range(_count(data, 68)):
        at += 68 + 16 * _INT.unpack_from(data, at + 64)[0]
    return at
