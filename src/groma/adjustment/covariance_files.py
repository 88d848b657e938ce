# SPDX-License-Identifier: BSD-3-Clause
"""Files of covariances: arrays (.npz), or standard deviations as text (.json). ``groma adjust --covariance``.

================ =============  ======================================================================================
Array            Shape          Content
================ =============  ======================================================================================
``image_names``  (N,)           images, and in ``image_frames`` the row of each one's pose
``poses``        (F, 6, 6)      left twist of ``cam_from_world`` or of the rig: shift, then turn
``centers``      (F, 3, 3)      centres in the world
``points``       (P, 3, 3)      places; ``point_ids`` names them
``lines``        (L, 6, 6)      Plücker coordinates (m, d) with a unit direction; ``line_ids``
``segment_ends`` (L, 2, 3, 3)   end points across their line
``planes``       (K, 4, 4)      (n, w) with a unit normal; ``plane_ids``
``directions``   (D, 3, 3)      unit vectors; ``direction_ids``
``gauge``        ()             ``inner`` or ``held``, and in ``sigma0`` the factor that was applied
================ =============  ======================================================================================

Scene units and radians; NaN: unobservable.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from groma._typing import FloatArray
from groma.adjustment.uncertainty import SceneUncertainty
from groma.bounded.json_text import json_text
from groma.errors import InputError
from groma.io import atomic_output
from groma.scene import Scene
from groma.scene.checks import check_scene_given

#: Fields of :class:`SceneUncertainty` that go into the file as they are.
_FIELDS = ("poses", "centers", "points", "lines", "segment_ends", "planes", "directions")


def write_covariances(
    path: str | os.PathLike[str], scene: Scene, uncertainty: SceneUncertainty, force: bool = False
) -> None:
    """Write the covariances of a scene atomically.

    Parameters
    ----------
    path : path
        Ends in ``.npz`` for arrays (the module lists them), or ``.json`` for standard deviations by name.
    scene : Scene
        The scene that ``uncertainty`` is about.
    uncertainty : SceneUncertainty
        As :func:`groma.uncertainty` returns it.
    force : bool
        Replace an existing file.

    Raises
    ------
    InputError
        If the name ends otherwise.
    OutputError
        If ``path`` exists already or cannot be written.
    """
    check_scene_given(scene)
    if Path(path).suffix not in (".npz", ".json"):
        raise InputError(f"A file of covariances must end in .npz or .json; got {path}.")
    if Path(path).suffix == ".json":
        with atomic_output(path, force) as draft:
            draft.write_text(json_text(standard_deviations(scene, uncertainty)), encoding="utf-8")
        return
    arrays: dict[str, Any] = {name: getattr(uncertainty, name) for name in _FIELDS}
    arrays |= {
        "gauge": np.array(uncertainty.gauge),
        "sigma0": np.array(uncertainty.sigma0),
        "image_names": np.array(scene.images.names, dtype=np.str_),
        "image_frames": np.asarray(scene.images.frame_idx),
        **{f"{kind}_ids": np.asarray(ids) for kind, ids in _ids(scene).items()},
    }
    with atomic_output(path, force) as draft, draft.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def standard_deviations(scene: Scene, found: SceneUncertainty) -> dict[str, Any]:
    """Return the standard deviations of everything by its name: along x, y, z in scene units, angles in degrees."""
    ids = _ids(scene)
    center, turn = _sigma(found.centers), np.rad2deg(_total(found.poses[:, 3:, 3:]))
    frames = scene.images.frame_idx
    ends = _sigma(found.segment_ends.reshape(-1, 3, 3)).reshape(-1, 2, 3)
    along = np.rad2deg(_total(found.lines[:, 3:, 3:]))
    normal, offset = np.rad2deg(_total(found.planes[:, :3, :3])), _sigma(found.planes[:, 3:, 3:])[:, 0]
    return {
        "gauge": found.gauge,
        "sigma0": found.sigma0,
        "summary": found.to_dict(),
        "images": [
            {"name": name, "center": center[frame].tolist(), "rotation_deg": float(turn[frame])}
            for name, frame in zip(scene.images.names, frames.tolist(), strict=True)
        ],
        "points": _rows(ids["point"], position=_sigma(found.points)),
        "lines": _rows(ids["line"], ends=ends, direction_deg=along),
        "planes": _rows(ids["plane"], normal_deg=normal, offset=offset),
        "directions": _rows(ids["direction"], angle_deg=np.rad2deg(_total(found.directions))),
    }


def _ids(scene: Scene) -> dict[str, Any]:
    kinds = {"point": scene.points, "line": scene.lines, "plane": scene.planes, "direction": scene.directions}
    return {kind: landmarks.ids for kind, landmarks in kinds.items()}


def _rows(ids: Any, **columns: FloatArray) -> list[dict[str, Any]]:
    values = {name: column.tolist() for name, column in columns.items()}
    return [{"id": int(ids[k]), **{name: column[k] for name, column in values.items()}} for k in range(len(ids))]


def _sigma(covariance: FloatArray) -> FloatArray:
    """Roots of the variances (N, m) of covariances (N, m, m)."""
    return np.sqrt(np.maximum(np.einsum("nii->ni", covariance), 0.0))


def _total(covariance: FloatArray) -> FloatArray:
    """Roots of the summed variances (N,) of covariances (N, m, m)."""
    return np.sqrt(np.maximum(np.einsum("nii->n", covariance), 0.0))
