# SPDX-License-Identifier: BSD-3-Clause
"""A scene cut into parts, the folder they lie in, and parts joined to a scene again."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from groma._typing import IntArray
from groma.adjustment.parts.same_scene import check_same_scene
from groma.adjustment.terms.relations import ANGLES
from groma.errors import InputError, OutputError
from groma.io.archive import read_archive, write_archive
from groma.scene import Scene
from groma.scene.checks import check_scene_given
from groma.scene.survey import Kind
from groma.scene.table import object_references

#: Observations of a part, where a scene is cut: about 400 MB while it is worked on.
PART_SIZE = 1_000_000
#: How parts in a folder are named.
PART_NAMES = "part-*.npz"
#: Tables that are the same in all parts.
SHARED = ("cameras", "rigs", "sensors", "frames", "images", "planes", "directions", "principal_point_priors")
#: Tables that are in the first part alone.
ONCE = (
    "keypoints", "plane_observations", "pose_priors", "camera_positions", "camera_poses",
    "control_points", "marks", "distances", "known_planes", "known_directions", "held",
)  # fmt: skip


def parts_of(folder: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Return the parts in a folder, ``part-*.npz``, by name."""
    return tuple(sorted(Path(folder).glob(PART_NAMES)))


def write_parts(
    scene: Scene, folder: str | os.PathLike[str], observations: int = PART_SIZE, force: bool = False
) -> tuple[Path, ...]:
    """Divide a scene into parts with about the given number of observations each.

    Landmarks are taken in the order of the first image that sees them, so that a part concerns few images; points that
    lie on lines are in the part of the first of these. Cameras, planes and directions are in all parts; a relation is
    in the part of its point or line. What concerns none is in the first part: relations between planes, planes
    measured in the cameras, poses known beforehand, measurements of other instruments.

    Parameters
    ----------
    scene : Scene
        What to cut; points on lines of other parts are not tied to these (:func:`num_ties_cut`).
    folder : path
        Where; made where it is missing.
    observations : int
        Approximate number in each part.
    force : bool
        Replace archives that exist in ``folder``.

    Returns
    -------
    tuple of Path
        ``part-00000.npz`` and so on, in ``folder``.

    Raises
    ------
    InputError
        If ``observations`` is not positive, or images were read row by row.
    OutputError
        If an archive exists already, or cannot be written.
    """
    check_scene_given(scene)
    if len(scene.camera_motions):
        raise InputError("Scenes with a rolling shutter are not adjusted in parts. Adjust the scene as a whole.")
    folder = Path(folder)
    of_points, of_lines = _parts_of_landmarks(scene, observations)
    folder.mkdir(parents=True, exist_ok=True)
    if parts_of(folder) and not force:
        raise OutputError(f"{folder} holds parts already. Pass force=True (--force) to replace them.")
    paths = []
    for number in np.unique(np.concatenate([of_points, of_lines])) if scene.num_points + scene.num_lines else (0,):
        paths.append(folder / f"part-{number:05d}.npz")
        cut = scene.keep(points=of_points == number, lines=of_lines == number)
        write_archive(_without_what_counts_once(cut) if paths[1:] else cut, paths[-1], force)
    for old in set(parts_of(folder)) - set(paths):
        old.unlink()  # of a scene that had more parts
    return tuple(paths)


def _parts_of_landmarks(scene: Scene, observations: int) -> tuple[IntArray, IntArray]:
    """Return the part of every point and every line."""
    if observations < 1:
        raise InputError(f"A part needs at least one observation; got {observations}. The default is {PART_SIZE}.")
    points, lines = scene.point_observations, scene.line_observations
    seen_points = np.bincount(points.point_idx, minlength=scene.num_points)
    seen_lines = np.bincount(lines.line_idx, minlength=scene.num_lines)
    seen = np.concatenate([seen_points, seen_lines])
    first = np.full(len(seen), scene.num_images)
    np.minimum.at(first, points.point_idx, points.image_idx)
    np.minimum.at(first, scene.num_points + lines.line_idx, lines.image_idx)
    order = np.argsort(first, kind="stable")
    part = np.empty(len(seen), np.int64)
    part[order] = (np.cumsum(seen[order]) - seen[order]) // observations
    of_points, of_lines = np.split(part, [scene.num_points])
    measured = np.zeros(scene.num_points, bool)  # what was measured of landmarks is in the first part, as they are
    for name, column, kinds in object_references(Scene):
        index, kind = getattr(getattr(scene, name), column), getattr(getattr(scene, name), kinds)
        measured[index[kind == Kind.POINT]] = True
        of_lines[index[kind == Kind.LINE]] = 0
    point, line = scene.relations.point_on_line.T
    of_lines[line[measured[point]]] = 0
    tied, pair = np.unique(point, return_index=True)
    of_points[tied] = of_lines[line[pair]]
    of_points[measured] = 0
    return of_points, of_lines


def num_ties_cut(scene: Scene, observations: int = PART_SIZE) -> int:
    """Return how many points on lines lie in another part than the line, if a scene is cut by :func:`write_parts`."""
    of_points, of_lines = _parts_of_landmarks(scene, observations)
    point, line = scene.relations.point_on_line.T
    return int((of_points[point] != of_lines[line]).sum())


def _without_what_counts_once(scene: Scene) -> Scene:
    """Return a scene without the tables that are in the first part only, since they would count once per part."""
    once: dict[str, list[int]] = {kind: [] for kind in ("lines_meeting", *ANGLES)}
    relations = scene.relations.take(**once)
    return scene.replace(relations=relations, **{name: type(getattr(scene, name))() for name in ONCE})


def join_parts(paths: Sequence[str | os.PathLike[str]]) -> Scene:
    """Return the scene that was cut into parts, its landmarks in the order of the parts.

    Raises
    ------
    InputError
        If there are none, or they do not have the same images, cameras and planes.
    """
    if not paths:
        raise InputError("There are no parts to join.")
    scenes = [read_archive(path) for path in paths]
    for path, scene in zip(paths, scenes, strict=True):
        check_same_scene(Path(path), scene, Path(paths[0]), scenes[0])
    return Scene(
        **{
            item.name: getattr(scenes[0], item.name) if item.name in SHARED else _joined(scenes, item.name)
            for item in fields(Scene)
        }
    )


def _joined(scenes: Sequence[Scene], name: str) -> Any:
    """Return a table of all parts; indices of landmarks count on."""
    kind, columns = type(getattr(scenes[0], name)), {}
    for item in fields(kind):
        values = [getattr(getattr(scene, name), item.name) for scene in scenes]
        shift = np.zeros(len(item.metadata["refers"]), np.int64)
        for k, scene in enumerate(scenes if len(shift) else ()):
            values[k] = values[k] + shift
            shift += [0 if table in SHARED else len(getattr(scene, table)) for table in item.metadata["refers"]]
        columns[item.name] = np.concatenate(values)
    return kind(**columns)
