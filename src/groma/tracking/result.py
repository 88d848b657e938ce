# SPDX-License-Identifier: BSD-3-Clause
"""The map as a scene: keyframes as images, active landmarks, all their measurements and relations."""

from __future__ import annotations

import numpy as np

from groma.scene import Relations, Scene
from groma.scene.camera import Cameras
from groma.tracking.frame.camera import PINHOLE, TrackCamera
from groma.tracking.map.map_scene import Seen, map_scene, stacked
from groma.tracking.map.relations import find_relations
from groma.tracking.map.track_map import TrackMap

#: Points seen in fewer keyframes do not go into the scene; where the camera stood still, there is but one.
MIN_VIEWS = 2


def map_to_scene(track_map: TrackMap, camera: TrackCamera, relations: bool = True, min_views: int = MIN_VIEWS) -> Scene:
    """Return a scene of the living keyframes, the landmarks, and all that was measured; poses are cam_from_world.

    Adjusting it is the problem of the last adjustment of the track.

    Parameters
    ----------
    track_map, camera
        The map, and the camera of all its keyframes.
    relations
        Whether landmarks that belong together were tied.
    min_views
        Points seen in fewer keyframes are left out, if there are as many keyframes.
    """
    living = track_map.living()
    cameras = Cameras.of([1], [PINHOLE], [camera.params], [camera.width, camera.height])
    if not living:
        return Scene(cameras=cameras)
    names, used = [], set()
    for keyframe in living:
        name = keyframe.name or f"{keyframe.index:06d}"
        names.append(name if name not in used else f"{keyframe.index:06d}_{name}")
        used.add(names[-1])
    measured, image, _ = stacked(track_map, living)
    often = np.bincount(measured.points.index, minlength=len(track_map.points)) >= min(min_views, len(living))
    keep = often[measured.points.index]
    points = Seen.of(measured.points.take(keep), image["points"][keep])
    lines = Seen.of(measured.lines, image["lines"])
    planes = Seen.of(measured.planes, image["planes"], np.flatnonzero(track_map.planes.alive))
    tied = find_relations(track_map, points.ids, lines.ids, planes.ids) if relations else Relations()
    poses = np.array([keyframe.pose for keyframe in living])
    return map_scene(camera, track_map, poses, names, points, lines, planes, relations=tied)


def about_rest(scene: Scene, num_poses: int) -> list[str]:
    """Say so where a map has one keyframe, whose measurements nothing confirms, of so many frames with a pose."""
    if scene.num_images != 1:
        return []
    why = "because the camera hardly moved" if num_poses > 1 else "as no other frame has a pose"
    return [f"The map has one keyframe, {why}: landmarks are where that view alone has them."]
