# SPDX-License-Identifier: BSD-3-Clause
"""A scene cut into parts, and the folder they lie in."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from groma.errors import InputError, OutputError
from groma.io.archive import write_archive
from groma.scene import PosePriors, Relations, Scene

#: Observations of a part, where a scene is cut: about 400 MB while it is worked on.
PART_SIZE = 1_000_000
#: How parts in a folder are named.
PART_NAMES = "part-*.npz"


def parts_of(folder: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Return the parts in a folder, ``part-*.npz``, by name."""
    return tuple(sorted(Path(folder).glob(PART_NAMES)))


def is_parts_folder(path: str | os.PathLike[str]) -> bool:
    """Tell whether a path is a folder with parts in it."""
    return Path(path).is_dir() and next(Path(path).glob(PART_NAMES), None) is not None


def write_parts(
    scene: Scene, folder: str | os.PathLike[str], observations: int = PART_SIZE, force: bool = False
) -> tuple[Path, ...]:
    """Cut a scene into parts with about so many observations each.

    Landmarks are taken in the order of the first image that sees them, so that a part concerns few images.

    Parameters
    ----------
    scene : Scene
        What to cut; its relations between landmarks are left out.
    folder : path
        Where; made where it is missing.
    observations : int
        About so many in each part.
    force : bool
        Replace archives that exist in ``folder``.

    Returns
    -------
    tuple of Path
        ``part-00000.npz`` and so on, in ``folder``.

    Raises
    ------
    InputError
        If ``observations`` is not positive.
    OutputError
        If an archive exists already, or cannot be written.
    """
    if observations < 1:
        raise InputError(f"A part needs at least one observation; got {observations}. The default is {PART_SIZE}.")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    if parts_of(folder) and not force:
        raise OutputError(f"{folder} holds parts already. Pass force=True (--force) to replace them.")
    scene, no_priors = scene.replace(relations=Relations()), {"pose_priors": PosePriors()}
    seen_points = np.bincount(scene.point_observations.point_idx, minlength=scene.num_points)
    seen_lines = np.bincount(scene.line_observations.line_idx, minlength=scene.num_lines)
    seen = np.concatenate([seen_points, seen_lines])
    first = np.full(len(seen), scene.num_images)
    np.minimum.at(first, scene.point_observations.point_idx, scene.point_observations.image_idx)
    np.minimum.at(first, scene.num_points + scene.line_observations.line_idx, scene.line_observations.image_idx)
    order = np.argsort(first, kind="stable")
    part = np.empty(len(seen), np.int64)
    part[order] = (np.cumsum(seen[order]) - seen[order]) // observations
    paths = []
    for number in np.unique(part):
        own = part == number
        paths.append(folder / f"part-{number:05d}.npz")
        cut = scene.keep(points=own[: scene.num_points], lines=own[scene.num_points :])
        cut = cut.replace(**no_priors) if paths[1:] else cut  # each counts once
        write_archive(cut, paths[-1], force)
    for old in set(parts_of(folder)) - set(paths):
        old.unlink()  # of a scene that had more parts
    return tuple(paths)


__all__ = ["PART_NAMES", "PART_SIZE", "is_parts_folder", "parts_of", "write_parts"]
