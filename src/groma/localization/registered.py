# SPDX-License-Identifier: BSD-3-Clause
"""Queries as further images of their map, with what they see of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from groma._typing import IntArray
from groma.errors import InputError
from groma.localization.map_index import MapIndex
from groma.localization.stored import StoredImage
from groma.scene import Cameras, Frames, Images, LineObservations, PointObservations, Points, Rigs, Scene, Sensors
from groma.scene.camera import CAMERA
from groma.scene.table import Table, joined, references

#: Folder for the names of queries that an image of the map has, too.
QUERY = "query/"


def with_queries(scene: Scene, index: MapIndex, queries: Sequence[StoredImage]) -> Scene:
    """Return a map with queries as images after its own, and the points that they see.

    A query with the calibration of the map's one camera of its size was taken with that; others have new cameras.

    Raises
    ------
    InputError
        If names are taken.
    """
    if not queries:
        return scene
    made = len(index.xyz) - scene.num_points  # of the index, before the points of the map
    seen = np.unique(np.concatenate([one.point for one in queries]))
    seen = seen[seen < made]
    row = np.full(len(index.xyz), -1)
    row[made:], row[seen] = np.arange(scene.num_points), scene.num_points + np.arange(len(seen))
    points = Points(
        scene.points.ids.max(initial=0) + 1 + np.arange(len(seen)),
        index.xyz[seen], np.full((len(seen), 3), 160, np.uint8), np.full(len(seen), -1.0),
    )  # fmt: skip
    number = np.arange(scene.num_images, scene.num_images + len(queries))
    tables = {"points": points, **_images(scene, queries), **_seen(queries, number, row)}
    tables = {name: joined(getattr(scene, name), table) for name, table in tables.items()}
    # What refers to rows of the map, like depths of its segments, still does: others come after them.
    referring = {name: getattr(scene, name) for name, *_, target in references(Scene) if target in tables}
    return scene.replace(**(referring | tables))


def _images(scene: Scene, queries: Sequence[StoredImage]) -> dict[str, Table]:
    """Frames and images of queries, and the cameras that the map lacks, each alone on a rig."""
    place = _own_cameras(scene)
    fresh = {_camera_key(one): one for one in queries if _camera_key(one) not in place}
    every, count = np.arange(len(fresh)), len(queries)
    sizes = len(scene.cameras), len(scene.rigs), len(scene.sensors)
    place |= {key: tuple(size + number for size in sizes) for number, key in enumerate(fresh)}
    camera, rig, sensor = np.array([place[_camera_key(one)] for one in queries]).T
    taken = max(int(ids.max(initial=0)) for ids in (scene.cameras.ids, scene.rigs.ids, scene.sensors.sensor_ids))
    ids, cameras = taken + 1 + every, [(one.model, one.params, one.size) for one in fresh.values()]
    sensors = Sensors(
        len(scene.rigs) + every, np.full(len(every), CAMERA), ids, len(scene.cameras) + every,
        np.tile([0, 0, 0, 1, 0, 0, 0.0], (len(every), 1)), np.ones(len(every), int), np.ones(len(every), int),
    )  # fmt: skip
    first = 1 + int(max(scene.images.ids.max(initial=0), scene.frames.ids.max(initial=0)))
    number = first + np.arange(count)
    tables: dict[str, Table] = {
        "frames": Frames(number, rig, np.stack([one.pose for one in queries])),
        "images": Images(number, _names(scene, queries), camera, scene.num_frames + np.arange(count), sensor),
    }
    if fresh:
        tables |= {"cameras": Cameras.of(ids, *zip(*cameras, strict=True)), "rigs": Rigs(ids), "sensors": sensors}
    return tables


def _own_cameras(scene: Scene) -> dict[tuple[object, ...], tuple[int, ...]]:
    """Camera, rig and sensor by calibration, of cameras alone on their rigs that no other of their size is beside."""
    cameras, table = scene.cameras, scene.sensors
    sizes = list(zip(cameras.width.tolist(), cameras.height.tolist(), strict=True))
    alone = np.bincount(table.rig_idx, minlength=len(scene.rigs))[table.rig_idx] == 1
    alone &= np.bincount(table.camera_idx[table.kind == CAMERA], minlength=len(cameras))[table.camera_idx] == 1
    out = {}
    for sensor in np.flatnonzero(alone & (table.kind == CAMERA)).tolist():
        camera = int(table.camera_idx[sensor])
        if sizes.count(sizes[camera]) == 1:
            key = (cameras.models[camera], *cameras.params_of(camera).tolist(), *sizes[camera])
            out[key] = camera, int(table.rig_idx[sensor]), sensor
    return out


def _names(scene: Scene, queries: Sequence[StoredImage]) -> tuple[str, ...]:
    """Names of queries; those that an image of the map has, too, are put into the folder ``query``."""
    taken = set(scene.images.names)
    names = tuple(f"{QUERY}{one.name}" if one.name in taken else one.name for one in queries)
    if len({*names, *taken}) < len(names) + len(taken):
        raise InputError("Queries and images of the map have the same names. Put the queries into a folder above.")
    return names


def _seen(queries: Sequence[StoredImage], number: IntArray, row: IntArray) -> dict[str, Table]:
    """What queries see: ``number`` are their images, ``row`` the points of the scene, of rows of the index."""
    of_points = np.repeat(number, [len(one.point) for one in queries])
    of_lines = np.repeat(number, [len(one.line) for one in queries])
    pixels, ends = (np.concatenate([getattr(one, name) for one in queries]) for name in ("pixel", "segment"))
    point, line = (np.concatenate([getattr(one, name) for one in queries]) for name in ("point", "line"))
    return {
        "point_observations": PointObservations.numbered(of_points, row[point], pixels),
        "line_observations": LineObservations(of_lines, line, ends, np.ones(len(line))),
    }


def _camera_key(one: StoredImage) -> tuple[object, ...]:
    return (one.model, *one.params.tolist(), *one.size.tolist())
