# SPDX-License-Identifier: BSD-3-Clause
"""Masks of photographs: a folder with one image for each, black where nothing is to be used.

``rooms/IMG_1.jpg`` has ``rooms/IMG_1.jpg.png``, as in COLMAP, ``rooms/IMG_1.png`` or ``rooms/IMG_1_mask.png``, of any
kind of image; where the folder has no folders, ``IMG_1.jpg.png`` and so on. A file is the mask of all photographs: what
the camera is mounted on is always at the same place. Masks of another resolution are read at the nearest pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Self

import cv2
import numpy as np

from groma._typing import BoolArray
from groma.bounded.images import decoded
from groma.bounded.names import IMAGES, files_below, masks_among
from groma.errors import FileFormatError, InputError
from groma.io.depth_maps import at_size, has_proportions
from groma.io.reading import reading

#: Grey levels that are black: in JPEG files levels are inexact, so that white is what is nearer to it (derived).
_BLACK, _BLACK_JPEG = 0, 127


def _state_of(path: Path) -> tuple[int, int]:
    stat = path.stat()
    return stat.st_size, stat.st_mtime_ns


@dataclass(frozen=True)
class Masks:
    """The masks of photographs. ``files`` are (name of the photograph, mask, its size and time of change)."""

    folder: Path
    files: tuple[tuple[str, Path, tuple[int, int]], ...]

    @classmethod
    def of(cls, folder: Path, names: Sequence[str]) -> Self:
        """Find the masks of photographs by their names.

        Raises
        ------
        InputError
            If the folder is none, or no photograph has a mask.
        """
        if folder.is_file() and folder.suffix.lower() in IMAGES:
            return cls(folder, tuple((name, folder, _state_of(folder)) for name in names))
        if not folder.is_dir():
            raise InputError(f"{folder} is not a folder of masks, nor a mask ({', '.join(IMAGES)}). Check the path.")
        found = {path.relative_to(folder).as_posix(): path for path in files_below(folder)}
        found = {name: path for name, path in found.items() if path.suffix.lower() in IMAGES}
        beside = masks_among(found)  # then the others are photographs
        known = {PurePosixPath(name).with_suffix("").as_posix(): found[name] for name in (beside or found)}
        places = [PurePosixPath(name) for name in names]
        if not any("/" in key for key in known) and len({place.stem for place in places}) == len(places):
            places = [PurePosixPath(place.name) for place in places]
        files = []
        for name, place in zip(names, places, strict=True):
            stem = place.with_suffix("").as_posix()
            path = next((known[key] for key in (place.as_posix(), stem, f"{stem}_mask") if key in known), None)
            if path is not None:
                files.append((name, path, _state_of(path)))
        if not files:
            example = next(iter(known.values()), None)
            there = f"it holds {example.name!r}" if example else "it holds no images"
            raise InputError(
                f"{folder} has a mask of none of the {len(names)} photographs; {there}, the first photograph is "
                f"{names[0]!r}. Give the masks the names of the photographs."
            )
        return cls(folder, tuple(files))

    @cached_property
    def file_of(self) -> dict[str, Path]:
        """The mask of each photograph that has one."""
        return {name: path for name, path, _ in self.files}

    def read(self, name: str, size: tuple[int, int]) -> BoolArray | None:
        """Return what may be used of a photograph of a size (width, height), (H, W); None: all, as it has no mask.

        Raises
        ------
        FileFormatError
            If the mask cannot be read, or has other proportions.
        """
        path = self.file_of.get(name)
        if path is None:
            return None
        with reading(path, "mask"):
            content = path.read_bytes()
            levels = decoded(content, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        if levels is None:
            raise FileFormatError(f"{path} cannot be read as an image. Write the mask again.")
        if not has_proportions(levels.shape, size):
            raise FileFormatError(
                f"{path} has {levels.shape[1]}x{levels.shape[0]} pixels, its photograph {size[0]}x{size[1]}. Pass "
                "masks of the proportions of the photographs."
            )
        is_jpeg = content[:2] == b"\xff\xd8"
        return np.asarray(at_size(levels, size) > (_BLACK_JPEG if is_jpeg else _BLACK), np.bool_)

    def write(self, folder: Path, name: str, size: tuple[int, int]) -> None:
        """Write the mask of a photograph as COLMAP reads it: ``NAME.png`` of its size, black or white."""
        used = self.read(name, size)
        if used is not None:
            target = folder / f"{name}.png"
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(cv2.imencode(".png", used.astype(np.uint8) * 255)[1].tobytes())
