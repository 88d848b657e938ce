# SPDX-License-Identifier: BSD-3-Clause
"""From one format of a scene to another."""

from __future__ import annotations

import os

from groma.io import read_scene, structures_of, write_scene
from groma.scene import Scene


def convert(source: str | os.PathLike[str], target: str | os.PathLike[str], force: bool = False) -> Scene:
    """Read a scene, write it in another format and return it.

    Parameters
    ----------
    source : path
        What :func:`groma.read_scene` reads.
    target : path
        Its name determines the format, as in :func:`groma.write_scene`. LIMAP's structures are kept.
    force : bool
        Replace an existing file.

    Raises
    ------
    InputError
        If ``source`` does not exist, or the format cannot hold the scene.
    FileFormatError
        If ``source`` is not a scene, or damaged.
    OutputError
        If ``target`` exists already or cannot be written.
    """
    scene = read_scene(source)
    write_scene(scene, target, force=force, like=structures_of(source))
    return scene
