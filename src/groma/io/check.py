# SPDX-License-Identifier: BSD-3-Clause
"""The conformance check of scene formats, public as :func:`groma.testing.check_format`."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path

import numpy as np

from groma.errors import FileFormatError, OutputError, require
from groma.io.registry import SceneFormat, check_target, formats, read_scene, write_scene
from groma.scene import Scene


def check_format(scene_format: SceneFormat | str, scene: Scene, holds: Iterable[str], tolerance: float = 1e-9) -> None:
    """Check that a registered format keeps its promises, by writing a scene and reading it.

    The name selects the format; its content survives writing and reading; existing files are replaced only with
    force; a truncated file raises :class:`~groma.errors.FileFormatError` or, if it holds no length, gives a scene.

    Parameters
    ----------
    scene_format : SceneFormat or str
        The format, or its name.
    scene : Scene
        What to write, valid for the format.
    holds : iterable of str
        Names of the tables of a scene that the format keeps, for example ``("lines",)``.
    tolerance : float
        Largest difference of a number.

    Raises
    ------
    AssertionError
        If one of these does not hold.
    """
    name = scene_format if isinstance(scene_format, str) else scene_format.name
    what, known = f"Format {name!r}", {one.name: one for one in formats()}
    require(name in known, what, f"is not registered; there are {', '.join(known)}")
    ending = next(iter(known[name].endings), "")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"scene{ending}"
        chosen = check_target(scene, path) if known[name].endings else name
        require(chosen == name, what, f"the ending {ending!r} chooses the format {chosen!r}")
        write_scene(scene, path, name)
        try:
            write_scene(scene, path, name)
        except OutputError:
            pass
        else:
            require(False, what, "a file is replaced without force; write within groma.io.atomic.atomic_output")
        write_scene(scene, path, name, force=True)
        if known[name].read is None:
            return
        _compare(what, scene, read_scene(path), holds, tolerance)
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
            try:
                read_scene(path)
            except FileFormatError:
                pass


def _compare(what: str, written: Scene, read: Scene, holds: Iterable[str], tolerance: float) -> None:
    for table in holds:
        before, after = getattr(written, table), getattr(read, table)
        for column in fields(before):
            one, two = np.asarray(getattr(before, column.name)), np.asarray(getattr(after, column.name))
            same = one.shape == two.shape
            if same and one.dtype.kind == "f":
                same = bool(np.allclose(one, two, rtol=0.0, atol=tolerance, equal_nan=True))
            elif same:
                same = bool((one == two).all())
            require(same, what, f"{table}.{column.name} comes back different:\n{one}\n{two}")
