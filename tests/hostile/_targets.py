# SPDX-License-Identifier: BSD-3-Clause
"""What is attacked: for every reader and format a folder of small good files, and what is done with them.

A target's folder is made once. Its ``read`` is called after one of its files has been changed; it returns what it has
read, or raises an error of groma. The kinds of files are in modules of their own: ``_targets_*.py``.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "io"))

GRAY = np.random.default_rng(0).integers(0, 255, (24, 32)).astype(np.uint8)


@dataclass(frozen=True)
class Target:
    """A reader, and the names of the files in its folder that are attacked."""

    name: str
    folder: Path
    files: tuple[str, ...]
    read: Callable[[Path], object]


#: What a module of targets yields: a name, the files of the folder, and what is done with it.
Made = tuple[str, dict[str, bytes], Callable[[Path], object]]


def targets(home: Path) -> list[Target]:
    """Make all targets in a folder."""
    made = []
    for name, files, read in _all(home):
        folder = home / name
        for file, content in files.items():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_bytes(content)
        made.append(Target(name, folder, tuple(files), read))
    return made


def _all(home: Path) -> Iterator[Made]:
    import _targets_frames
    import _targets_kept
    import _targets_networks
    import _targets_scenes
    import _targets_surveys
    import _targets_tables

    for kind in (_targets_scenes, _targets_tables, _targets_frames, _targets_surveys, _targets_kept, _targets_networks):
        yield from kind.made(home)


def one(read: Callable[[Path], object], name: str) -> Callable[[Path], object]:
    """Return a reader of a folder that reads one of its files."""
    return lambda folder: read(folder / name)


def npz(**arrays: object) -> bytes:
    """Return an ``.npz`` file of arrays; two underscores in a name stand for a bar, as in names of pairs."""
    stream = io.BytesIO()
    np.savez(stream, **{name.replace("__", "|"): np.asarray(value) for name, value in arrays.items()})
    return stream.getvalue()


def npy(array: np.ndarray) -> bytes:
    """Return an ``.npy`` file."""
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def encoded(ending: str, image: np.ndarray = GRAY) -> bytes:
    """Return an image as a file."""
    return bytes(cv2.imencode(ending, image)[1])
