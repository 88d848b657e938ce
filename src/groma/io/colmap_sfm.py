# SPDX-License-Identifier: BSD-3-Clause
"""A first model of points and poses from photographs alone, by pycolmap: SIFT, matching, incremental mapping."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from groma.errors import InputError
from groma.io.colmap import from_pycolmap
from groma.scene import Scene

#: Up to this many images every pair is matched; beyond it each image is matched with its followers by name.
EXHAUSTIVE_LIMIT = 120
_OVERLAP = 12


def reconstruct_points(
    images: str | os.PathLike[str],
    work: str | os.PathLike[str],
    progress: Callable[[str], None] | None = None,
    seed: int = 0,
) -> Scene:
    """Reconstruct poses and points from a folder of photographs.

    Parameters
    ----------
    images : path
        Folder of photographs, taken by one camera.
    work : path
        Folder for the database; what is finished there is not done again.
    progress : callable, optional
        Called with a sentence at the start of each stage.
    seed : int
        Seed of the random numbers of matching and mapping.

    Returns
    -------
    Scene
        The largest model found.

    Raises
    ------
    InputError
        If no model comes out: too few images, no overlap, or no texture.
    """
    import pycolmap

    say = progress or (lambda sentence: None)
    folder = Path(work)
    folder.mkdir(parents=True, exist_ok=True)
    database = folder / "database.db"
    pycolmap.set_random_seed(seed)
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    say("finding SIFT points")
    pycolmap.extract_features(database, images, camera_mode=pycolmap.CameraMode.SINGLE, device=pycolmap.Device.cpu)
    names = [path for path in Path(images).iterdir() if path.is_file()]
    say("matching points")
    if len(names) <= EXHAUSTIVE_LIMIT:
        pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
    else:
        options = pycolmap.SequentialPairingOptions()
        options.overlap = _OVERLAP
        pycolmap.match_sequential(database, pairing_options=options, device=pycolmap.Device.cpu)
    say("reconstructing points and poses")
    models = pycolmap.incremental_mapping(database, images, folder / "models")
    if not models:
        raise InputError(
            f"No reconstruction came out of the {len(names)} files in {images}: the images do not overlap enough, or "
            "show too little texture for points. Take more images with more overlap, or pass a model with --model."
        )
    best = max(models.values(), key=lambda model: model.num_reg_images())
    return from_pycolmap(best)
