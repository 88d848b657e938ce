# SPDX-License-Identifier: BSD-3-Clause
"""The map of an earlier track, to be tracked in: its scene, and the frames of its keyframes, become a map again.

The scene holds keyframes, landmarks and observations; depths, described features and
edges are found again in the frames, as they were then. A keyframe has no time stamp: that of a frame to come may be the
same.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from groma._typing import IntArray
from groma.errors import InputError
from groma.features.edge_fit import measure_edges
from groma.io.sequences.frame import Frame
from groma.scene import Scene
from groma.tracking.frame.camera import PINHOLE, TrackCamera, back, into
from groma.tracking.frame.features import FrameFeatures
from groma.tracking.frame.measurements import LineMeasurements, Measurements, PlaneMeasurements
from groma.tracking.map.feature_points import linked_to_points
from groma.tracking.map.keyframes import measure_points
from groma.tracking.map.landmarks import ALIVE
from groma.tracking.map.planes import grow
from groma.tracking.map.points import PointTracks
from groma.tracking.map.track_map import Keyframe, TrackMap
from groma.tracking.options import TrackOptions

#: Cameras whose parameters differ by less, relatively, are the same.
_SAME_CAMERA = 1e-3


def is_metric(scene: Scene) -> bool:
    """Whether depths or right images gave a map its scale."""
    return any(len(getattr(scene, name)) for name in ("point_depths", "right_columns", "plane_observations"))


def map_of_scene(
    scene: Scene,
    frames: Mapping[str, Frame],
    camera: TrackCamera,
    options: TrackOptions,
    say: Callable[[int, int], None] = lambda done, total: None,
) -> TrackMap:
    """Return the map of a track from its scene.

    Parameters
    ----------
    scene
        What :func:`groma.tracking.result.map_to_scene` made.
    frames
        The frame of each of its images, by the name of the image.
    camera
        Of the frames to come.
    options
        What is tracked.
    say
        Called with the keyframes that are done, and how many there are.

    Raises
    ------
    InputError
        If the map was made with another camera, or frames are missing.
    """
    _check_camera(scene, camera)
    track_map = TrackMap()
    _add_landmarks(track_map, scene)
    for image, name in enumerate(scene.images.names):
        _add_keyframe(track_map, scene, image, FrameFeatures(frames[name], camera, options))
        say(image + 1, scene.num_images)
    _note_views(track_map)
    track_map.reference = len(track_map.keyframes) - 1
    return track_map


def _check_camera(scene: Scene, camera: TrackCamera) -> None:
    cameras = scene.cameras
    here = np.array([camera.width, camera.height])
    if len(cameras) == 1 and cameras.models[0] == PINHOLE:
        size = np.array([cameras.width[0], cameras.height[0]])
        if (size == here).all() and np.allclose(cameras.params[0, :4], camera.params, rtol=_SAME_CAMERA):
            if len(scene.right_columns) and not np.allclose(
                scene.right_columns.baseline, camera.baseline, rtol=_SAME_CAMERA
            ):
                raise InputError(
                    "The map was made with pairs of images, the sequence has none of that baseline. Track pairs."
                )
            return
    sizes = zip(cameras.models, cameras.width, cameras.height, strict=True)
    told = "; ".join(f"{model} {width}x{height}" for model, width, height in sizes)
    raise InputError(
        f"The map was made with another camera ({told or 'none'}) than the sequence (PINHOLE {here[0]}x{here[1]}, "
        f"focal length {camera.fx:.1f}). Pass --camera, or a map that groma track made of the same camera."
    )


def _add_landmarks(track_map: TrackMap, scene: Scene) -> None:
    points, lines, planes, relations = track_map.points, track_map.lines, track_map.planes, scene.relations
    rows = points.extend(scene.num_points)
    points.xyz[rows], points.state[rows] = scene.points.xyz, ALIVE
    rows = lines.extend(scene.num_lines)
    lines.plucker[rows], lines.segment[rows] = scene.lines.plucker, scene.lines.segments
    lines.state[rows] = ALIVE
    rows = planes.extend(len(scene.planes))
    planes.hesse[rows], planes.state[rows] = scene.planes.hesse, ALIVE
    for table, kind in ((points, "point_on_plane"), (lines, "line_on_plane")):
        pairs = getattr(relations, kind)
        table.plane[pairs[:, 0]] = pairs[:, 1]
        table.plane_sigma[pairs[:, 0]] = getattr(relations, f"{kind}_sigma")


def _add_keyframe(track_map: TrackMap, scene: Scene, image: int, data: FrameFeatures) -> None:
    """Add the keyframe of an image of the scene, with all that was measured in it."""
    options, pose = data.options, scene.cam_from_world[image]
    seen = scene.point_observations
    rows = np.flatnonzero(seen.image_idx == image)
    tracks = PointTracks(seen.point_idx[rows], seen.pixel[rows])
    tracks = tracks.take(np.unique(tracks.index, return_index=True)[1])
    points = measure_points(track_map, data, pose, tracks)
    features = linked_to_points(data.features, tracks, options.gates.points.same_feature)
    measured = Measurements(points, _lines(track_map, scene, image, data), _planes(track_map, scene, image, data))
    depth = float(np.median(into(pose, track_map.points.xyz[tracks.index])[:, 2])) if len(tracks) else 1.0
    track_map.keyframes.append(
        Keyframe(
            image, math.nan, scene.images.names[image], pose.copy(), data.gray, measured, features, data.depth_grid,
            max(depth, 1e-6),
        )
    )  # fmt: skip


def _lines(track_map: TrackMap, scene: Scene, image: int, data: FrameFeatures) -> LineMeasurements:
    seen = scene.line_observations
    rows = np.flatnonzero(seen.image_idx == image)
    index, ends = seen.line_idx[rows], seen.segment[rows]
    if not len(rows):
        return LineMeasurements.empty()
    track_map.lines.strength[index] = measure_edges(data.gray, ends)[2]
    return LineMeasurements(index, ends, seen.sigma[rows], *data.inverse_depths(ends))


def _planes(track_map: TrackMap, scene: Scene, image: int, data: FrameFeatures) -> PlaneMeasurements:
    """What the image measured of planes; those of the map grow by where the frame shows them again."""
    seen, found = scene.plane_observations, data.planes
    rows = np.flatnonzero(seen.image_idx == image)
    if not len(rows):
        return PlaneMeasurements.empty()
    index, plane = seen.plane_idx[rows], seen.plane_in_cam[rows]
    for k, own in zip(index.tolist(), plane, strict=True):
        if found is not None and len(found):
            same = int(np.abs(found.plane - own).sum(axis=1).argmin())
            places = back(scene.cam_from_world[image], found.places_of(same))
            grow(track_map.planes, k, places, float(found.support[same]), data.options.gates.planes)
    return PlaneMeasurements(index, plane, seen.sqrt_information[rows])


def _note_views(track_map: TrackMap) -> None:
    """Note for each landmark its first and last keyframe, and how often it was seen."""
    points, lines = track_map.points, track_map.lines
    for keyframe in track_map.keyframes:
        table, edges = keyframe.measured.points, keyframe.measured.lines
        points.keyframe[table.index], points.pixel[table.index] = keyframe.index, table.pixel
        _note_first(points.first_keyframe, points.first_pixel, table.index, table.pixel, keyframe.index)
        _note_first(lines.first_keyframe, lines.first_ends, edges.index, edges.ends, keyframe.index)


def _note_first(first: IntArray, place: np.ndarray, index: IntArray, measured: np.ndarray, number: int) -> None:
    new = first[index] < 0
    first[index[new]], place[index[new]] = number, measured[new]
