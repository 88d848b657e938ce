# SPDX-License-Identifier: BSD-3-Clause
"""What frames measure of a map, as a scene: of one frame, of a window of keyframes, or of all of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np

from groma._rows import numbered
from groma._typing import FloatArray, IntArray
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.stages import METRIC_LOSS, METRIC_RELATION_LOSS
from groma.scene import (
    Cameras,
    LineDepths,
    LineObservations,
    Lines,
    PlaneObservations,
    Planes,
    PointDepths,
    PointObservations,
    Points,
    Relations,
    RightColumns,
    Scene,
)
from groma.scene.table import Table
from groma.tracking.frame.camera import PINHOLE, TrackCamera
from groma.tracking.frame.measurements import LineMeasurements, Measurements, PlaneMeasurements, PointMeasurements
from groma.tracking.map.landmarks import ALIVE
from groma.tracking.map.track_map import Keyframe, TrackMap

#: How tracking assembles problems. Points are near and well known, and keep to plain steps.
TRACKING = AssemblyOptions(
    point_chart="euclidean",
    loss=METRIC_LOSS,
    relation_loss=METRIC_RELATION_LOSS,
    drop_behind=False,
    require_in_front=True,
    gauge="free",
)


_Table = TypeVar("_Table", PointMeasurements, LineMeasurements, PlaneMeasurements)


@dataclass(frozen=True)
class Seen(Generic[_Table]):
    """Measurements of landmarks of one kind by several images: those of landmark ``ids[k]`` have the index k."""

    ids: IntArray
    table: _Table
    image: IntArray

    @classmethod
    def of(cls, table: _Table, image: IntArray, ids: IntArray | None = None) -> Seen[_Table]:
        """Number the landmarks of measurements; ``ids``, ascending, by default those that are measured."""
        ids = np.unique(table.index) if ids is None else ids
        return cls(ids, replace(table, index=np.searchsorted(ids, table.index)), image)


def stacked(
    track_map: TrackMap, keyframes: list[Keyframe]
) -> tuple[Measurements, dict[str, IntArray], dict[str, IntArray]]:
    """Return what keyframes measure of living landmarks, one below the other; merged planes under their new number.

    By kind follow the keyframe of each, and its row in the table of that keyframe.
    """
    whole: dict[str, Any] = {}
    image: dict[str, IntArray] = {}
    row: dict[str, IntArray] = {}
    for kind, tables in {"points": PointMeasurements, "lines": LineMeasurements, "planes": PlaneMeasurements}.items():
        parts = [getattr(keyframe.measured, kind) for keyframe in keyframes]
        of, place = numbered(np.array([len(part) for part in parts], np.int64))
        table, landmarks = tables.stack(parts), getattr(track_map, kind)
        if kind == "planes":
            table = replace(table, index=track_map.planes.now(table.index))
        living = np.flatnonzero(landmarks.state[table.index] == ALIVE)
        whole[kind], image[kind], row[kind] = table.take(living), of[living], place[living]
    return Measurements(**whole), image, row


def map_scene(
    camera: TrackCamera,
    track_map: TrackMap,
    poses: FloatArray,
    names: list[str],
    points: Seen[PointMeasurements],
    lines: Seen[LineMeasurements],
    planes: Seen[PlaneMeasurements],
    **more: Table | Relations,
) -> Scene:
    """Return the scene of some images, their landmarks, and everything measured of them.

    Parameters
    ----------
    camera
        Of all images.
    track_map
        Holds the landmarks; those of the scene keep their numbers there, plus one, as identifiers.
    poses : (F, 7)
        cam_from_world.
    names
        Of the images.
    points, lines, planes
        What the images measure.
    **more
        Further tables of the scene.
    """
    cameras = Cameras.of([1], [PINHOLE], [camera.params], [camera.width, camera.height])
    count = len(points.ids)
    return Scene.from_images(
        cameras,
        names,
        np.zeros(len(names), int),
        poses,
        points=Points(points.ids + 1, track_map.points.xyz[points.ids], np.full((count, 3), 128), np.zeros(count)),
        lines=Lines(lines.ids + 1, track_map.lines.plucker[lines.ids], track_map.lines.segment[lines.ids]),
        planes=Planes(planes.ids + 1, track_map.planes.hesse[planes.ids]),
        **_point_tables(camera, points.table, points.image),
        **_line_tables(camera, lines.table, lines.image),
        plane_observations=PlaneObservations(
            planes.image, planes.table.index, planes.table.plane, planes.table.sqrt_information
        ),
        **more,
    )


def _point_tables(camera: TrackCamera, table: PointMeasurements, image: IntArray) -> dict[str, object]:
    tables: dict[str, object] = {
        "point_observations": PointObservations.numbered(image, table.index, table.pixel, table.sigma)
    }
    rows = np.flatnonzero(np.isfinite(table.depth))
    if len(rows):
        tables["point_depths"] = PointDepths(image[rows], table.index[rows], table.depth[rows], table.depth_sigma[rows])
    rows = np.flatnonzero(np.isfinite(table.right[:, 0]))
    if len(rows):
        baseline = np.full(len(rows), camera.baseline)
        tables["right_columns"] = RightColumns(rows, table.right[rows, 0], baseline, table.sigma[rows])
    return tables


def _line_tables(camera: TrackCamera, table: LineMeasurements, image: IntArray) -> dict[str, object]:
    if not len(table):
        return {}
    tables: dict[str, object] = {"line_observations": LineObservations(image, table.index, table.ends, table.sigma)}
    rows = np.flatnonzero(np.isfinite(table.inverse_depth).all(axis=1))
    if len(rows):
        baseline = np.full(len(rows), camera.line_baseline)
        tables["line_depths"] = LineDepths(rows, table.inverse_depth[rows], table.inverse_depth_sigma[rows], baseline)
    return tables
