# SPDX-License-Identifier: BSD-3-Clause
"""Depth maps of photographs: a folder with one 16-bit PNG, ``.npy`` or ``.npz`` for each, of the same size.

In come the folder and the names of photographs; ``rooms/IMG_1.jpg`` has ``rooms/IMG_1.png``, or ``IMG_1.png`` where the
folder has no folders. Out come images of depths along the optical axis, 0 where nothing is known: what is zero,
negative or not finite, and 65535 in whole numbers of 16 bit. Headers are checked before data are decompressed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import numpy.typing as npt

from groma.bounded.arrays import Array, Header, opened_arrays, read_array
from groma.bounded.images import decoded
from groma.errors import FileFormatError, InputError
from groma.io.reading import reading

#: Endings of depth maps, in small letters.
ENDINGS = (".png", ".npy", ".npz")
#: Whole numbers in files per unit of length: millimetres (convention: of the format).
WHOLE_NUMBERS = 1000.0
#: The array of an ``.npz`` file that holds more than one.
_ARRAY = "depth"
#: What stands for "not measured" in the format of 16 bits.
_UNKNOWN = 65535
#: What a picture decoder gives: any number of channels and bits.
_UNCHANGED = -1

DepthMap = npt.NDArray[np.float32]


@dataclass(frozen=True)
class DepthMaps:
    """A folder of depth maps, and the unit of its values."""

    folder: Path
    #: Numbers in files per unit of length; None: 1000 for whole numbers (millimetres), 1 for others (metres).
    scale: float | None = None
    #: Every map has its own scale, as those of monocular depth networks.
    relative: bool = False

    def __post_init__(self) -> None:
        if self.scale is not None and not (math.isfinite(self.scale) and self.scale > 0.0):
            raise InputError(
                f"The scale of depth maps must be positive (numbers in files per metre); got {self.scale}."
            )

    def files(self, names: Sequence[str]) -> list[Path | None]:
        """Return the depth map of each photograph, None where there is none.

        Raises
        ------
        InputError
            If the folder is none, a photograph has two maps, or no photograph has one.
        """
        if not self.folder.is_dir():
            raise InputError(f"{self.folder} is not a folder of depth maps ({', '.join(ENDINGS)}). Check the path.")
        maps: dict[str, list[Path]] = {}
        for path in sorted(self.folder.rglob("*")):
            if path.suffix.lower() in ENDINGS and path.is_file():
                maps.setdefault(path.relative_to(self.folder).with_suffix("").as_posix(), []).append(path)
        stems = [PurePosixPath(name).with_suffix("") for name in names]
        if not any("/" in key for key in maps) and len({stem.name for stem in stems}) == len(stems):
            stems = [PurePosixPath(stem.name) for stem in stems]
        found = [maps.get(stem.as_posix(), []) for stem in stems]
        twice = next((paths for paths in found if len(paths) > 1), None)
        if twice is not None:
            raise InputError(f"A photograph has two depth maps, {twice[0]} and {twice[1].name}. Remove one of them.")
        if not any(found):
            example = next((paths[0].name for paths in maps.values()), None)
            there = f"it holds {example!r}" if example else f"it holds no {', '.join(ENDINGS)}"
            raise InputError(
                f"{self.folder} has a depth map of none of the {len(names)} photographs; {there}, the first photograph "
                f"is {names[0]!r}. Give the maps the names of the photographs."
            )
        return [paths[0] if paths else None for paths in found]

    def read(self, path: Path, size: tuple[int, int]) -> DepthMap:
        """Read the depth map of a photograph of a size (width, height); (H, W), units of length, 0 where unknown.

        Raises
        ------
        FileFormatError
            If the file holds no depth map, or one of another size.
        """
        with reading(path, "depth map"):
            raw = _read_png(path) if path.suffix.lower() == ".png" else _read_arrays(path, size)
        raw = raw.reshape([n for n in raw.shape if n != 1] if raw.ndim > 2 else raw.shape)
        _check_size(path, raw.shape, size)
        whole = raw.dtype.kind in "iu"
        depth = raw.astype(np.float32) / np.float32(self.scale or (WHOLE_NUMBERS if whole else 1.0))
        with np.errstate(invalid="ignore"):
            bad = ~(np.isfinite(depth) & (depth > 0.0)) | (whole & (raw == _UNKNOWN))
        depth[bad] = 0.0
        return depth

    def holds_millimetres(self, depth: DepthMap, path: Path) -> bool:
        """Whether a map read in metres by default probably holds millimetres: large whole numbers."""
        if self.scale is not None or self.relative or path.suffix.lower() == ".png":
            return False
        known = depth[depth > 0.0]
        return bool(len(known)) and float(np.median(known)) > 100.0 and bool((known == np.round(known)).all())


def _read_png(path: Path) -> Array:
    image = decoded(path.read_bytes(), _UNCHANGED)
    if image is None:
        raise FileFormatError(f"{path} cannot be read as a PNG. Write it again.")
    if image.dtype != np.uint16 or image.ndim != 2:
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise FileFormatError(
            f"{path} has {channels} {'channel' if channels == 1 else 'channels'} of {8 * image.dtype.itemsize} bits; "
            "expected a grey PNG of 16 bits. Save depths as 16-bit PNG, .npy or .npz."
        )
    return image


def _read_arrays(path: Path, size: tuple[int, int]) -> Array:
    def check(header: Header) -> None:
        if header.dtype.kind not in "iuf":
            raise FileFormatError(f"{path} holds {header.dtype}; expected numbers. Save depths as numbers.")
        _check_size(path, tuple(n for n in header.shape if n != 1 or len(header.shape) < 3), size)

    if path.suffix.lower() == ".npy":
        return read_array(path, check)
    with opened_arrays(path) as arrays:
        name = _ARRAY if _ARRAY in arrays else arrays.names[0] if len(arrays.names) == 1 else None
        if name is None:
            raise FileFormatError(
                f"{path} holds the arrays {', '.join(arrays.names[:5]) or 'none'}; expected one, or one named "
                f"{_ARRAY!r}."
            )
        return arrays.read(name, check)


def _check_size(path: Path, shape: tuple[int, ...], size: tuple[int, int]) -> None:
    """Refuse an array that is not (height, width)."""
    if shape == (size[1], size[0]):
        return
    if len(shape) != 2:
        raise FileFormatError(f"{path} has the shape {shape}; expected (height, width), {(size[1], size[0])}.")
    turned = " It is turned by 90 degrees." if shape == size else ""
    raise FileFormatError(
        f"{path} has {shape[1]}x{shape[0]} pixels, its photograph {size[0]}x{size[1]}.{turned} Pass depth maps of the "
        "size of the photographs, registered to them."
    )
