# SPDX-License-Identifier: BSD-3-Clause
"""Recordings for the rerun viewer (``.rrd``): the scene in 3D, every image with what was measured in it.

Entities: ``world/points``, ``world/lines``, ``world/planes/ID``, and ``world/images/NAME`` with pose and pinhole, below
it ``points`` and ``segments`` as measured. Numbers are in single precision, so the scene is shifted to its middle; the
value ``shift`` of ``world`` holds the offset. The package rerun-sdk writes the files; it is large, hence an extra.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
from typing import Any

import numpy as np

from groma._typing import FloatArray
from groma.errors import InputError
from groma.io.atomic import atomic_output
from groma.io.drawn import Drawn, DrawnCameras, drawn, drawn_cameras, middle_of
from groma.io.registry import SceneFormat, register_format
from groma.scene import Scene
from groma.scene.checks import check_scene_given
from groma.scene.patches import triangle_fans

#: Width of an image where it is not known, pixels.
_WIDTH = 640.0


def check_recording(_: Scene) -> None:
    """Raise InputError if rerun is not installed."""
    if importlib.util.find_spec("rerun") is None:
        raise InputError('Recordings for rerun need the package rerun-sdk: pip install "groma[rerun]".')


def write_recording(scene: Scene, path: str | os.PathLike[str], force: bool = False) -> None:
    """Write a recording for the rerun viewer.

    Parameters
    ----------
    scene : Scene
        What to write.
    path : path
        The file, ``.rrd``.
    force : bool
        Replace an existing file.

    Raises
    ------
    InputError
        If rerun is not installed.
    """
    check_scene_given(scene)
    check_recording(scene)
    rerun: Any = importlib.import_module("rerun")
    shown, images = drawn(scene), drawn_cameras(scene)
    with atomic_output(path, force) as draft:
        stream = rerun.RecordingStream("groma", recording_id="scene")
        stream.save(draft)
        shift = middle_of(shown, images)
        axis = "XYZ"[int(np.argmax(np.abs(up := images.up)))]
        way = "UP" if up["XYZ".index(axis)] > 0 else "DOWN"
        stream.log("world", getattr(rerun.ViewCoordinates, f"RIGHT_HAND_{axis}_{way}"), static=True)
        stream.log("world", rerun.AnyValues(shift=shift), static=True)
        _log_geometry(rerun, stream, shown, shift)
        _log_images(rerun, stream, scene, images, shift)
        stream.flush()
        stream.disconnect()


def _log_geometry(rerun: Any, stream: Any, shown: Drawn, shift: FloatArray) -> None:
    if len(shown.points):
        stream.log("world/points", rerun.Points3D(shown.points - shift, colors=shown.point_colours), static=True)
    if len(shown.pieces):
        strips = rerun.LineStrips3D(shown.pieces - shift, colors=shown.piece_colours)
        stream.log("world/lines", strips, static=True)
    for number, polygon, colour in zip(shown.plane_ids, shown.polygons, shown.polygon_colours, strict=True):
        colours = np.tile([*colour.tolist(), 110], (len(polygon), 1)).astype(np.uint8)
        mesh = rerun.Mesh3D(
            vertex_positions=polygon - shift, triangle_indices=triangle_fans([polygon])[1], vertex_colors=colours
        )
        stream.log(f"world/planes/{number}", mesh, static=True)


def _log_images(rerun: Any, stream: Any, scene: Scene, images: DrawnCameras, shift: FloatArray) -> None:
    camera = scene.images.camera_idx
    points, lines = scene.point_observations, scene.line_observations
    for row, name in enumerate(images.names):
        pose, entity = images.world_from_cam[row], ["world", "images", name]
        width, height = (float(side[camera[row]]) for side in (scene.cameras.width, scene.cameras.height))
        if not (width > 0 and height > 0):
            width, height = _WIDTH, _WIDTH / images.aspect[row]
        focal = float(0.5 * height / np.tan(0.5 * images.opening[row]))
        stream.log(entity, rerun.Transform3D(translation=pose[:3, 3] - shift, mat3x3=pose[:3, :3]), static=True)
        pinhole = rerun.Pinhole(
            image_from_camera=np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]]),
            resolution=[width, height],
            camera_xyz=rerun.ViewCoordinates.RDF,
            image_plane_distance=images.depth,
        )
        stream.log(entity, pinhole, static=True)
        if len(pixels := points.pixel[points.image_idx == row]):
            stream.log([*entity, "points"], rerun.Points2D(pixels), static=True)
        if len(segments := lines.segment[lines.image_idx == row]):
            stream.log([*entity, "segments"], rerun.LineStrips2D(segments.reshape(-1, 2, 2)), static=True)


register_format(
    SceneFormat("rerun", target=".rrd for rerun", endings=(".rrd",), write=write_recording, check=check_recording)
)
