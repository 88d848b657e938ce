# SPDX-License-Identifier: BSD-3-Clause
"""Depth maps of photographs: a folder with one PNG or TIFF, ``.npy``, ``.npz`` or map of COLMAP for each.

In come the folder and the names of photographs; ``rooms/IMG_1.jpg`` has ``rooms/IMG_1.png`` or COLMAP's
``rooms/IMG_1.jpg.geometric.bin``, or ``IMG_1.png`` where the folder has no folders. Out come images of depths along the
optical axis, of the size of the photographs: maps of another resolution are read at the nearest pixel. 0 is where
nothing is known: what is zero, negative or not finite, and 65535 in whole numbers of 16 bit. Headers are checked
before data are decompressed.
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
from groma.bounded.names import files_below
from groma.errors import FileFormatError, InputError
from groma.io.reading import reading

#: Endings of depth maps, in small letters.
ENDINGS = (".png", ".tif", ".tiff", ".npy", ".npz", ".bin")
#: Endings of COLMAP's maps, after the whole name of the photograph; the first is better where there are both.
_COLMAP = (".geometric.bin", ".photometric.bin")
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
        for path in files_below(self.folder):
            if path.suffix.lower() in ENDINGS:
                name = path.relative_to(self.folder).as_posix()
                key = PurePosixPath(name.removesuffix(_COLMAP[0]).removesuffix(_COLMAP[1])).with_suffix("").as_posix()
                if not (name.endswith(_COLMAP[1]) and key in maps):
                    maps.setdefault(key, []).append(path)
        stems = [PurePosixPath(name).with_suffix("") for name in names]
        if not any("/" in key for key in maps) and len({stem.name for stem in stems}) == len(stems):
            stems = [PurePosixPath(stem.name) for stem in stems]
        found = [maps.get(stem.as_posix(), []) for stem in stems]
        twice = next((paths for paths in found if len(paths) > 1), None)
        if twice is not None:
            raise InputError(f"A photograph has two depth maps, {twice[0]} and {twice[1].name}. Remove one of them.")
        if not any(found):
            wanted = {stem.name for stem in stems}
            unread = [path.name for path in self.folder.rglob("*") if path.stem in wanted]
            if unread and not maps:
                raise InputError(
                    f"{self.folder} holds maps of a kind that is not read, for example {min(unread)!r}. Save them as "
                    "16-bit PNG, .npy or .npz."
                )
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
            If the file holds no depth map, or one of other proportions.
        """
        ending = path.suffix.lower()
        with reading(path, "depth map"):
            if ending == ".bin":
                raw = _read_colmap(path)
            else:
                raw = _read_arrays(path, size) if ending in (".npy", ".npz") else _read_picture(path)
        raw = raw.reshape([n for n in raw.shape if n != 1] if raw.ndim > 2 else raw.shape)
        _check_size(path, raw.shape, size)
        raw = at_size(raw, size)
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


def has_proportions(shape: tuple[int, ...], size: tuple[int, int]) -> bool:
    """Whether a shape is (height, width) of a size (width, height), or of one made smaller or larger."""
    if len(shape) != 2 or not min(shape):
        return False
    # derived: width and height of the smaller image are each off by less than a pixel of it
    slip = abs(shape[1] * size[1] - shape[0] * size[0])
    scaled = shape[1] != size[0] and shape[0] != size[1] and slip < max(sum(size), sum(shape))
    return scaled or shape == (size[1], size[0])


def at_size(raw: Array, size: tuple[int, int]) -> Array:
    """Return the nearest pixels of an image (h, w) at those of a size (width, height)."""
    if raw.shape == (size[1], size[0]):
        return raw
    row, column = ((np.arange(n) + 0.5) * m / n for n, m in zip(size[::-1], raw.shape, strict=True))
    return raw[np.ix_(row.astype(np.int64), column.astype(np.int64))]


def _read_picture(path: Path) -> Array:
    image = decoded(path.read_bytes(), _UNCHANGED)
    if image is None:
        raise FileFormatError(f"{path} cannot be read as a PNG or TIFF. Write it again.")
    if image.dtype not in (np.uint16, np.float32, np.float64) or image.ndim != 2:
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise FileFormatError(
            f"{path} has {channels} {'channel' if channels == 1 else 'channels'} of {8 * image.dtype.itemsize} bits; "
            "expected a grey PNG of 16 bits. Save depths as 16-bit PNG, .npy or .npz."
        )
    return image


def _read_colmap(path: Path) -> Array:
    """Read a map of COLMAP: width, height and channels as text, each with ``&``, then single precision, row by row."""
    *words, data = path.read_bytes().split(b"&", 3)
    shape = [int(word) for word in words if word.isdigit() and len(word) < 10]
    if len(shape) != 3 or shape[2] != 1 or len(data) != 4 * math.prod(shape):
        raise FileFormatError(f"{path} is no depth map of COLMAP, or is damaged. Write it again.")
    return np.frombuffer(data, "<f4").reshape(shape[1], shape[0])


def _read_arrays(path: Path, size: tuple[int, int]) -> Array:
    def check(header: Header) -> None:
        if header.dtype.kind not in "iuf":
            raise FileFormatError(f"{path} holds {header.dtype}; expected numbers. Save depths as numbers.")
        _check_size(path, tuple(n for n in header.shape if n != 1 or len(header.shape) < 3), size)

    if path.suffix.lower() == ".npy":
        return read_array(path, check)
    with opened_arrays(path) as arrays:
        if _ARRAY not in arrays and len(arrays.names) != 1:
            raise FileFormatError(
                f"{path} holds the arrays {', '.join(arrays.names[:5]) or 'none'}; expected one, or one named "
                f"{_ARRAY!r}."
            )
        return arrays.read(_ARRAY if _ARRAY in arrays else arrays.names[0], check)


def _check_size(path: Path, shape: tuple[int, ...], size: tuple[int, int]) -> None:
    """Refuse an array that is not (height, width), or has other proportions."""
    if len(shape) != 2:
        raise FileFormatError(f"{path} has the shape {shape}; expected (height, width), {(size[1], size[0])}.")
    if has_proportions(shape, size):
        return
    turned = " It is turned by 90 degrees." if shape == size else ""
    raise FileFormatError(
        f"{path} has {shape[1]}x{shape[0]} pixels, its photograph {size[0]}x{size[1]}.{turned} Pass depth maps of the "
        "proportions of the photographs, registered to them."
    )
