# SPDX-License-Identifier: BSD-3-Clause
"""Posed images whose lines are mapped by the benchmark of lines: photographs, and renderings whose edges are known."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from _buildings import KINDS, BuildingSettings, render_building
from _rendered_boxes import BoxSettings, render_boxes
from _workshop import CACHE

from groma.features import LsdDetector, Segments
from groma.features.close_edges import CloseEdges
from groma.features.contrast import WithContrast
from groma.io import read_scene
from groma.io.colmap.model import from_pycolmap
from groma.scene import Scene


@dataclass(frozen=True, eq=False)
class LineScene:
    """Images, poses, points, and the truth where there is one."""

    name: str
    scene: Scene
    images: list[np.ndarray]
    #: (E, 2, 3) true edges, or None.
    edges: np.ndarray | None = None
    #: Distances at which lines are compared with the edges, scene units.
    thresholds: list[float] = field(default_factory=list)
    #: (2, 3) two corners of the box in which the edges were marked, or None where all are known.
    box: np.ndarray | None = None

    def segments(self, min_length: float) -> list[Segments]:
        """Return groma's segments of each image."""
        detector = WithContrast(CloseEdges(LsdDetector(min_length=min_length)))
        return [detector.detect(image) for image in self.images]


def boxes(name: str, settings: BoxSettings) -> LineScene:
    """Return rendered boxes; one scene unit is taken for a metre."""
    rendered = render_boxes(settings)
    return LineScene(name, rendered.scene, rendered.images, rendered.edges, [0.001, 0.005])


def unseen(name: str) -> LineScene:
    """Return the textured boxes or building of a seed, such as ``stairs-3103``, at four shares of its extent."""
    kind, seed = name.split("-")
    if kind == "boxes":
        rendered = render_boxes(BoxSettings(seed=int(seed), texture=10.0, width=640, height=480, focal=560.0))
    else:
        rendered = render_building(BuildingSettings(kind, int(seed)))
    extent = float(np.linalg.norm(np.ptp(rendered.edges.reshape(-1, 3), axis=0)))
    thresholds = [k * extent for k in (0.0002, 0.001, 0.005, 0.01)]
    return LineScene(name, rendered.scene, rendered.images, rendered.edges, thresholds)


def strecha(name: str, folder: Path) -> LineScene:
    """Return one of Strecha's surveyed scenes: photographs with known poses, no edges."""
    scene = read_scene(folder / "sparse_gt")
    return LineScene(name, scene, _photographs(folder, scene))


def pavilion(name: str, folder: Path) -> LineScene:
    """Return the Barcelona pavilion: renderings with exact cameras and a graph of marked edges.

    Thresholds are 1, 5 and 10 thousandths of the extent, the diagonal of the box that holds the marked points between
    their 2nd and 98th percentile: single points lie far outside of the view. That box, widened by a tenth of the
    extent, is where edges were marked; walls and trees behind it were not.
    """
    scene = _triangulated(folder)
    with np.load(folder / "gt_edges.npz") as archive:
        points, pairs = archive["points"], archive["edges"]
    low, high = np.quantile(points, [0.02, 0.98], axis=0)
    extent = float(np.linalg.norm(high - low))
    thresholds = [k * extent for k in (0.001, 0.005, 0.01)]
    box = np.array([low - 0.1 * extent, high + 0.1 * extent])
    return LineScene(name, scene, _photographs(folder, scene), points[pairs], thresholds, box)


def _photographs(folder: Path, scene: Scene) -> list[np.ndarray]:
    images = [cv2.imread(str(folder / "images" / name), cv2.IMREAD_GRAYSCALE) for name in scene.images.names]
    missing = [name for name, image in zip(scene.images.names, images, strict=True) if image is None]
    if missing:
        raise SystemExit(f"{folder / 'images'} lacks {', '.join(missing[:3])}.")
    return [image for image in images if image is not None]


def _triangulated(folder: Path) -> Scene:
    """Points of the pavilion from SIFT matches under the exact cameras; made once, by pycolmap."""
    model_folder = CACHE / "pavilion"
    if not (model_folder / "points3D.bin").is_file():
        import pycolmap

        pycolmap.logging.minloglevel = 2
        pycolmap.set_random_seed(0)
        model_folder.mkdir(parents=True, exist_ok=True)
        database = model_folder / "database.db"
        database.unlink(missing_ok=True)
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model, reader.camera_params = "PINHOLE", "700,700,320,180"
        single, device = pycolmap.CameraMode.SINGLE, pycolmap.Device.cpu
        pycolmap.extract_features(database, folder / "images", camera_mode=single, reader_options=reader, device=device)
        pycolmap.match_exhaustive(database, device=device)
        rows = [line.split() for line in (folder / "poses.txt").read_text().splitlines() if line[:1] not in ("#", "")]
        pose_of = {row[0]: np.array(row[5:], float) for row in rows}  # qw qx qy qz tx ty tz
        model = pycolmap.Reconstruction()
        table = pycolmap.Database.open(database)
        camera = table.read_all_cameras()[0]
        model.add_camera_with_trivial_rig(camera)
        for image in table.read_all_images():
            qw, *rest = pose_of[image.name]
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([*rest[:3], qw])), np.array(rest[3:]))
            posed = pycolmap.Image(name=image.name, image_id=image.image_id, camera_id=camera.camera_id)
            model.add_image_with_trivial_frame(posed, pose)
        table.close()
        found = pycolmap.triangulate_points(model, database, folder / "images", model_folder, refine_intrinsics=False)
        found.write(model_folder)
        return from_pycolmap(found)
    return read_scene(model_folder)


#: Smaller images of the same view.
SMALL: dict[str, Any] = {"width": 640, "height": 480, "focal": 560.0}
#: Settings of the scenes of boxes.
_BOXES = {
    "boxes": BoxSettings(seed=3),
    "boxes-textured": BoxSettings(seed=11, texture=8.0),
    "boxes-fine": BoxSettings(seed=35, texture=10.0, blotches=256),
    "boxes-rough": BoxSettings(seed=34, texture=15.0, **SMALL),
    "boxes-strong": BoxSettings(seed=42, texture=20.0),
    "boxes-strong-small": BoxSettings(seed=43, texture=20.0, **SMALL),
    "boxes-small": BoxSettings(seed=5, **SMALL),
    "boxes-random": BoxSettings(seed=115, cameras="random"),
    "boxes-random-small": BoxSettings(seed=117, cameras="random", **SMALL),
    "boxes-noisy": BoxSettings(seed=110, noise=6.0),
    "boxes-wide": BoxSettings(seed=106, width=640, height=480, focal=480.0),
    "boxes-few": BoxSettings(seed=119, num_images=12),
    "boxes-many": BoxSettings(seed=121, num_images=48),
    "boxes-held-small": BoxSettings(seed=401, texture=10.0, **SMALL),
    "boxes-held-random": BoxSettings(seed=403, texture=12.0, cameras="random"),
    "boxes-held-many": BoxSettings(seed=404, num_images=48, texture=10.0, **SMALL),
    # Rendered on 23 November 2026, when nothing was changed any more.
    "boxes-new-tex10": BoxSettings(seed=1301, texture=10.0),
    "boxes-new-tex20": BoxSettings(seed=1302, texture=20.0),
    "boxes-new-tex10-small": BoxSettings(seed=1303, texture=10.0, **SMALL),
    "boxes-new-tex20-small": BoxSettings(seed=1304, texture=20.0, **SMALL),
    "boxes-round": BoxSettings(seed=621, num_boxes=5, num_round=9, num_images=36, texture=6.0),
    "boxes-round-small": BoxSettings(seed=622, num_boxes=4, num_round=9, **SMALL),
    "boxes-round-random": BoxSettings(seed=623, num_boxes=4, num_round=9, texture=10.0, cameras="random"),
}
#: By name: what makes the scene from the folder of data.
SCENES: dict[str, Callable[[Path], LineScene]] = {
    **{name: lambda _, name=name: boxes(name, _BOXES[name]) for name in _BOXES},
    "pavilion": lambda data: pavilion("pavilion", data / "pavilion_chair"),
    "fountain": lambda data: strecha("fountain", data / "strecha_fountain_p11"),
    "herz-jesus": lambda data: strecha("herz-jesus", data / "strecha_herz_jesus_p8"),
    "castle": lambda data: strecha("castle", data / "strecha_castle_p30"),
}
#: ... and ``KIND-SEED`` for scenes that nobody has looked at.
UNSEEN = re.compile("(" + "|".join(["boxes", *KINDS]) + r")-\d+")
#: Shortest segment of the photographs, pixels; elsewhere that of the options of mapping.
MIN_LENGTH = {"fountain": 20.0, "herz-jesus": 20.0, "castle": 20.0}
#: LIMAP gets the longer ones of these only: its time grows with their square.
LIMAP_MIN_LENGTH = {"fountain": 40.0, "herz-jesus": 40.0, "castle": 40.0}
#: Neighbours per image of the photographs; elsewhere that of the options of mapping.
NUM_NEIGHBORS = {"fountain": 6, "herz-jesus": 6, "castle": 6}
