# SPDX-License-Identifier: BSD-3-Clause
"""The map as a scene: keyframes as images, living landmarks with their observations, and what lies on what."""

from __future__ import annotations

import numpy as np

from groma.scene import Scene
from groma.scene.camera import Cameras
from groma.scene.landmarks import Lines, Planes, Points
from groma.scene.observations import LineObservations, PointObservations, Relations
from groma.tracking.frame.camera import PINHOLE, TrackCamera
from groma.tracking.map.track_map import TrackMap

#: Points seen in fewer keyframes do not go into the scene.
MIN_VIEWS = 2


def map_to_scene(track_map: TrackMap, camera: TrackCamera) -> Scene:
    """Return a scene of the living keyframes and landmarks; poses are cam_from_world."""
    living = track_map.living()
    cameras = Cameras(
        np.array([1]), (PINHOLE,), camera.params[None], np.array([camera.width]), np.array([camera.height])
    )
    if not living:
        return Scene(cameras=cameras)
    names, used = [], set()
    for keyframe in living:
        name = keyframe.name or f"{keyframe.index:06d}"
        names.append(name if name not in used else f"{keyframe.index:06d}_{name}")
        used.add(names[-1])
    measured = [track_map.living_measurements(keyframe) for keyframe in living]
    image = {
        kind: np.repeat(np.arange(len(living)), [len(getattr(m, kind)) for m in measured])
        for kind in ("points", "lines")
    }
    points = np.concatenate([m.points.index for m in measured])
    pixels = np.concatenate([m.points.pixel for m in measured])
    often = np.bincount(points, minlength=len(track_map.points)) >= MIN_VIEWS
    keep = often[points]
    point_ids, point_idx = np.unique(points[keep], return_inverse=True)
    image_of = image["points"][keep]
    lines = np.concatenate([m.lines.index for m in measured])
    line_ids, line_idx = np.unique(lines, return_inverse=True)
    plane_ids = np.flatnonzero(track_map.planes.alive)
    hesse = track_map.planes.hesse[plane_ids]
    place = np.full(len(track_map.planes) + 1, -1)
    place[plane_ids] = np.arange(len(plane_ids))
    on_plane = place[track_map.lines.plane[line_ids]] if len(line_ids) else np.zeros(0, np.int64)
    rows = np.flatnonzero((track_map.lines.plane[line_ids] >= 0) & (on_plane >= 0)) if len(line_ids) else on_plane
    segments = track_map.lines.segment[line_ids]
    return Scene.from_images(
        cameras,
        names,
        np.zeros(len(living), int),
        np.array([keyframe.pose for keyframe in living]),
        points=Points(
            point_ids + 1, track_map.points.xyz[point_ids], np.full((len(point_ids), 3), 128), np.zeros(len(point_ids))
        ),
        point_observations=PointObservations.numbered(image_of, point_idx, pixels[keep]),
        lines=Lines.through(segments, line_ids + 1) if len(line_ids) else Lines(),
        line_observations=LineObservations(image["lines"], line_idx, np.concatenate([m.lines.ends for m in measured])),
        planes=Planes(plane_ids + 1, hesse),
        relations=Relations(line_on_plane=np.column_stack([rows, on_plane[rows]])),
    )


__all__ = ["map_to_scene"]
