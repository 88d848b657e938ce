# SPDX-License-Identifier: BSD-3-Clause
"""Photographs that were localised in a map, with the map as a model to map from: points tie all of them together."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from groma._typing import BoolArray, FloatArray, IntArray
from groma.bounded.names import stays_inside
from groma.errors import InputError
from groma.execution import map_work
from groma.gates import NORMAL, chi_square_gate
from groma.io.colmap.masks import Masks
from groma.localization.features import DescribedPoints, find_corners, find_points
from groma.localization.map_index import MapIndex, Progress
from groma.localization.registered import with_queries
from groma.localization.retrieval import VladRetrieval
from groma.localization.stored import StoredImage
from groma.localization.triangulation import triangulate_features
from groma.mapping.image_segments import is_used
from groma.mapping.noise.landmarks import pixels_of
from groma.mapping.photographs import read_gray
from groma.scene import Keypoints, PointObservations, Points, Scene
from groma.scene.table import joined

#: Images that the features of an image are matched with (cost: time).
_NEIGHBORS = 12
#: Features of two kinds at one place, pixels.
_SAME_PLACE = 1.0


def with_photographs(
    scene: Scene,
    index: MapIndex,
    queries: Sequence[StoredImage],
    files: Sequence[Path],
    say: Progress,
    masks: Masks | None = None,
) -> Scene:
    """Return a map with more photographs, and points that tie them to it and to each other.

    Features of all photographs are matched and triangulated at the poses as they are. A track through a place where
    the map observes a point of its own is that point, if it is at the place of all its features; others that a new
    photograph sees become points.

    Parameters
    ----------
    scene, index
        The map.
    queries
        The new photographs.
    files
        Of all photographs, those of the map first.
    say
        Progress.
    masks
        What may be used of the photographs.

    Raises
    ------
    InputError
        If an image cannot be read, or no point is seen by a new photograph.
    """
    both = with_queries(scene, index, [_without_landmarks(one) for one in queries])
    photographs = list(zip(both.images.names, files, strict=True))
    features = map_work(partial(_find, masks), photographs, partial(say, "finding points in images"))
    made = triangulate_features(both, features, _pairs(features), partial(say, "placing points"))
    image = np.repeat(np.arange(len(features)), [len(one) for one in features])
    row = np.flatnonzero(made.point >= 0)
    image, track = image[row], made.point[row]
    pixels, sigma = (np.concatenate([getattr(one, name) for one in features])[row] for name in ("pixels", "sigma"))
    new = image >= scene.num_images
    reach = _SAME_PLACE + math.sqrt(chi_square_gate(NORMAL.outlier, 2)) * made.noise * sigma
    own = _own_points(both, image, pixels, reach, track, len(made.xyz))
    fresh = (own < 0) & (np.bincount(track[new], minlength=len(made.xyz)) > 0)
    point = np.where(own >= 0, own, both.num_points + np.cumsum(fresh) - 1)[track]
    used = (new & (own[track] >= 0)) | fresh[track]
    if not (used & new).any():
        raise InputError("No point is seen by a new photograph and another. Check that they are those of the map.")
    # Two tracks may lead to one point: an image then sees it once.
    used[used] = _first_of_each(np.column_stack([image, point])[used])
    usual = float(np.median(sigma[used]))
    added = PointObservations.numbered(image[used], point[used], pixels[used], sigma[used] / usual)
    ids = both.points.ids.max(initial=0) + 1 + np.arange(int(fresh.sum()))
    points = Points(ids, made.xyz[fresh], np.full((len(ids), 3), 160, np.uint8), np.full(len(ids), -1.0))
    seen = joined(both.point_observations, added)
    seen = PointObservations.numbered(seen.image_idx, seen.point_idx, seen.pixel, seen.sigma)
    return both.replace(points=joined(both.points, points), point_observations=seen, keypoints=Keypoints())


def _without_landmarks(one: StoredImage) -> StoredImage:
    none = np.zeros(0, np.int64)
    return replace(one, point=none, pixel=np.zeros((0, 2)), line=none, segment=np.zeros((0, 4)))


def _own_points(
    scene: Scene, image: IntArray, pixels: FloatArray, reach: FloatArray, track: IntArray, count: int
) -> IntArray:
    """The point (T,) of a map that each of the tracks shows; -1 for none.

    It is at the place of one feature of the track, and within reach of all: at one place of an image there may be
    points of different depth.
    """
    seen = scene.point_observations
    own = np.full(count, -1)
    for k in range(scene.num_images):
        theirs, ours = np.flatnonzero(seen.image_idx == k), np.flatnonzero(image == k)
        if len(theirs) and len(ours):
            near = KDTree(seen.pixel[theirs]).query(pixels[ours], distance_upper_bound=_SAME_PLACE)
            distance, nearest = np.asarray(near[0]), np.asarray(near[1])
            hit = np.isfinite(distance) & (own[track[ours]] < 0)
            own[track[ours[hit]]] = seen.point_idx[theirs[nearest[hit]]]
    rows = np.flatnonzero(own[track] >= 0)
    away = np.linalg.norm(pixels_of(scene, image[rows], scene.points.xyz[own[track[rows]]]) - pixels[rows], axis=1)
    own[track[rows[~(away <= reach[rows])]]] = -1
    return own


def _first_of_each(rows: IntArray) -> BoolArray:
    first = np.zeros(len(rows), bool)
    first[np.unique(rows, axis=0, return_index=True)[1]] = True
    return first


def _find(masks: Masks | None, photograph: tuple[str, Path]) -> DescribedPoints:
    name, path = photograph
    image = read_gray(path)
    points = find_points(image).joined(find_corners(image))
    used = None if masks is None else masks.read(name, (image.shape[1], image.shape[0]))
    return points if used is None else points.take(is_used(used, points.pixels))


def _pairs(features: Sequence[DescribedPoints]) -> IntArray:
    """Pairs (n, 2) of images that are alike."""
    retrieval = VladRetrieval.learned([one.descriptors for one in features])
    described = np.stack([retrieval.gather(one.descriptors) for one in features])
    alike = described @ described.T
    np.fill_diagonal(alike, -np.inf)
    nearest = np.argsort(-alike, axis=1, kind="stable")[:, : min(_NEIGHBORS, len(features) - 1)]
    first = np.repeat(np.arange(len(features)), nearest.shape[1])
    return np.unique(np.sort(np.column_stack([first, nearest.ravel()]), axis=1), axis=0)


def gather_photographs(folder: Path, files: Mapping[str, Path]) -> None:
    """Make a folder of links to photographs, by their names in a map; where there are no links, of copies.

    Raises
    ------
    InputError
        If the folder holds something else, or a name leads out of it.
    """
    for name, file in files.items():
        place = folder / name
        if not stays_inside(name):
            raise InputError(f"The image name {name!r} leads out of its folder. Rename the image in the map.")
        if place.is_symlink() or place.exists():
            if place.resolve() == file.resolve():
                continue
            raise InputError(f"{place} is there already, and is not {file}. Move {folder} away.")
        place.parent.mkdir(parents=True, exist_ok=True)
        try:
            place.symlink_to(os.path.abspath(file))
        except OSError:
            shutil.copyfile(file, place)
