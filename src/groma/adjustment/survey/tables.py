# SPDX-License-Identifier: BSD-3-Clause
"""Tables of positions and control points from files: names are found in the scene, accuracies as they were stated."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from groma._counted import counted, first_of
from groma._image_names import rows_by_name, tell_partly
from groma._typing import BoolArray, FloatArray, IntArray
from groma.adjustment.survey.given import Survey
from groma.adjustment.survey.names import nearest, require_some
from groma.errors import InputError
from groma.io.survey import ControlFile, Places
from groma.scene import CameraPositions, ControlPoints, Marks, Scene
from groma.scene.survey import CHECK, CONTROL, UNKNOWN, diagonal_covariance

#: Names that a sentence lists at most (convention: what a sentence can hold).
_LISTED = 5


def position_table(scene: Scene, survey: Survey, xyz: FloatArray, notes: list[str]) -> CameraPositions:
    """Return the table of positions."""
    given = survey.positions
    assert given is not None
    rows = rows_by_name(given.names, scene.images.names)
    require_some(rows, given.names, scene.images.names, given.source)
    notes += tell_partly(rows, given.names, scene.images.names, given.source)
    tell_unknown(given, rows, scene.images.names, notes)
    known = np.flatnonzero(np.asarray(rows) >= 0)
    sigma = sigma_of(given, survey.position_sigma or given.usual_sigma, "--position-sigma")
    if (twice := len(known) - len(np.unique(rows[known]))) > 0:
        raise InputError(f"{given.source}: {counted(twice, 'images')} have two positions under different names.")
    return CameraPositions(rows[known], xyz[known], diagonal_covariance(sigma[known]))


def control_tables(
    scene: Scene, survey: Survey, given: ControlFile, xyz: FloatArray, notes: list[str]
) -> tuple[ControlPoints, Marks]:
    """Return the tables of control points and of their marks."""
    places = given.places
    known_place: BoolArray = np.asarray(np.isfinite(xyz).all(axis=1))
    if unknown := [name for name in survey.check if name not in places.names]:
        raise InputError(
            f"--check names {unknown[0]!r}, which is no control point{nearest(unknown[0], places.names)}. The file has "
            f"{', '.join(places.names[:_LISTED])}."
        )
    image = rows_by_name(given.image_names, scene.images.names)
    require_some(image, given.image_names, scene.images.names, places.source)
    notes += tell_partly(image, given.image_names, scene.images.names, places.source)
    if missing := len(set(np.asarray(given.image_names)[image < 0].tolist())):
        notes.append(
            f"{places.source}: {counted(int((image < 0).sum()), 'marks')} in {counted(missing, 'images')} that are not "
            "in the scene."
        )
    pixels = given.pixels
    if given.normalized:
        camera = scene.images.camera_idx[np.maximum(image, 0)]
        extent = np.stack([scene.cameras.width[camera], scene.cameras.height[camera]], axis=1).astype(float)
        pixels = pixels * extent.max(axis=1, keepdims=True) + extent / 2.0
    _check_inside(scene, places.source, image, pixels)
    is_check = given.is_check | np.isin(places.names, survey.check)
    role = np.where(~known_place, UNKNOWN, np.where(is_check, CHECK, CONTROL))
    marked = np.bincount(given.point_idx[image >= 0], minlength=len(role))
    keep = np.flatnonzero((marked >= 2) | ((marked == 1) & (role == CONTROL)))
    if left := [places.names[row] for row in np.flatnonzero(~np.isin(np.arange(len(role)), keep))]:
        notes.append(f"Left out, marked in too few images: {listed(left, 'control points')}.")
    sigma = sigma_of(places, survey.control_sigma, "--control-sigma", known_place & (role != UNKNOWN))
    names = tuple(places.names[row] for row in keep)
    start = np.where(known_place[:, None], xyz, 0.0)[keep]
    points = ControlPoints(names, start, start, diagonal_covariance(sigma[keep]), role[keep])
    new_row = np.full(len(role), -1)
    new_row[keep] = np.arange(len(keep))
    rows = np.flatnonzero((image >= 0) & (new_row[given.point_idx] >= 0))
    noise = np.full(len(rows), survey.mark_sigma_px)
    return points, Marks(image[rows], new_row[given.point_idx[rows]], pixels[rows], noise)


def _check_inside(scene: Scene, source: str, image: IntArray, pixels: FloatArray) -> None:
    """Refuse marks outside their images: they were made in images of another size."""
    camera = scene.images.camera_idx[np.maximum(image, 0)]
    size = np.stack([scene.cameras.width[camera], scene.cameras.height[camera]], axis=1)
    outside = (image >= 0) & (size > 0).all(axis=1) & ((pixels < -1.0) | (pixels > size + 1.0)).any(axis=1)
    if outside.any():
        row = int(np.argmax(outside))
        name, (width, height) = scene.images.names[image[row]], size[row]
        many = int(outside.sum())
        raise InputError(
            f"{source}: {counted(many, 'marks')} {'lies' if many == 1 else 'lie'} outside their images, such as "
            f"({pixels[row, 0]:.0f}, {pixels[row, 1]:.0f}) in {name} of {width} x {height} pixels. Were they made in "
            "images of another size?"
        )


def sigma_of(given: Places, stated: tuple[float, ...], option: str, needed: Any = True) -> FloatArray:
    """Return standard deviations (N, 3): of the file, else as stated."""
    sigma = given.sigma.copy()
    if stated:
        east, north, up = {1: stated * 3, 2: (stated[0], *stated), 3: stated}[len(stated)]
        sigma[:] = np.where(np.isfinite(sigma), sigma, [east, north, up])
    missing = ~np.isfinite(sigma).all(axis=1)
    if (missing & needed).any():
        raise InputError(
            f"{given.source} states no accuracy of its coordinates. Pass it: {option} 0.02, or horizontal and "
            f"vertical: {option} 0.02,0.04 (units of the coordinates)."
        )
    sigma[missing] = 1.0
    return sigma


def tell_unknown(given: Places, rows: IntArray, known: Sequence[str], notes: list[str]) -> None:
    """Add a note on unknown names of a file, with the most similar image without a measurement."""
    unknown = [given.names[row] for row in np.flatnonzero(rows < 0)]
    if unknown:
        named = set(rows.tolist())
        free = [name for row, name in enumerate(known) if row not in named]
        told = [name + nearest(name, free) for name in unknown[:_LISTED]] + unknown[_LISTED:]
        notes.append(
            f"{given.source}: {counted(len(unknown), 'positions')} of images that are not in the scene: "
            f"{first_of(told, _LISTED)}."
        )


def listed(names: Sequence[str], kind: str) -> str:
    """Return how many there are, and the first names."""
    return f"{counted(len(names), kind)}, {first_of(names, _LISTED)}"
