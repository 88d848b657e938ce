# SPDX-License-Identifier: BSD-3-Clause
"""What files for other programs show of a scene: points, supported pieces of lines, pieces of planes, cameras.

The pieces of planes are the convex hulls of what lies on them (:mod:`groma.scene.patches`). Lines of one shared
direction have one colour, and so have planes of about one size.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from groma import cameras
from groma._typing import FloatArray, IntArray
from groma.errors import InputError
from groma.geometry import se3
from groma.scene import Scene
from groma.scene.line_intervals import line_pieces
from groma.scene.local_frame import up_of
from groma.scene.patches import PALETTE, patch_groups, plane_patches

Part = Literal["points", "lines", "planes"]
PARTS: tuple[Part, ...] = ("points", "lines", "planes")
Colours = npt.NDArray[np.uint8]
#: Points whose colours are not known; lines that share their direction with no others.
_POINT_GREY = 128
_LINE_COLOUR = (220, 60, 40)
#: Half the widest opening of a camera that is written, radians: no picture plane holds more.
_WIDEST = 1.2


@dataclass(frozen=True)
class Drawn:
    """Geometry with colours."""

    #: (P, 3) places and colours of points.
    points: FloatArray
    point_colours: Colours
    #: (S, 2, 3) pieces of lines, (S, 3) their colours, and (S,) the line of each.
    pieces: FloatArray
    piece_colours: Colours
    piece_line: IntArray
    #: K convex polygons (n, 3), (K, 3) their colours, and the identifiers of their planes.
    polygons: list[FloatArray]
    polygon_colours: Colours
    plane_ids: list[int]

    @cached_property
    def places(self) -> FloatArray:
        """(n, 3) all vertices: points, ends of pieces, corners."""
        return np.concatenate([self.points, self.pieces.reshape(-1, 3), *self.polygons])

    @cached_property
    def colours(self) -> Colours:
        """(n, 3) colours of the vertices."""
        corners = np.repeat(self.polygon_colours, [len(polygon) for polygon in self.polygons], axis=0)
        return np.concatenate([self.point_colours, np.repeat(self.piece_colours, 2, axis=0), corners])


@dataclass(frozen=True)
class DrawnCameras:
    """Cameras with pictures of one plane; panoramas are as wide as a picture plane may be."""

    names: tuple[str, ...]
    #: (N, 4, 4) poses ``world_from_cam``: x right, y down, z forward.
    world_from_cam: FloatArray
    #: (N,) vertical opening, radians, and width over height.
    opening: FloatArray
    aspect: FloatArray
    #: (3,) the direction that is up.
    up: FloatArray
    #: Depth at which picture planes are drawn, scene units: such that neighbours do not hide each other.
    depth: float

    def corners(self) -> FloatArray:
        """(N, 4, 3) corners of the picture planes in the world, around the picture."""
        down = np.tan(0.5 * self.opening)
        side = np.stack([self.aspect * down, down, np.ones_like(down)], axis=1)[:, None]
        local = self.depth * side * np.array([[-1.0, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
        rotation, center = self.world_from_cam[:, :3, :3], self.world_from_cam[:, None, :3, 3]
        return np.einsum("nij,nkj->nki", rotation, local) + center

    def frusta(self) -> FloatArray:
        """(N, 8, 2, 3) strokes of the cameras in the world."""
        corners = self.corners()
        center = np.broadcast_to(self.world_from_cam[:, None, :3, 3], corners.shape)
        around = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
        return np.concatenate([around, np.stack([center, corners], axis=2)], axis=1)


def drawn(scene: Scene, parts: Collection[Part] = PARTS) -> Drawn:
    """Return what files show of a scene.

    Raises
    ------
    InputError
        If ``parts`` is not a selection of points, lines and planes.
    """
    unknown = set(parts) - set(PARTS)
    if isinstance(parts, str) or unknown or not parts:
        raise InputError(f"parts must be some of {', '.join(PARTS)}; got {parts!r}.")
    num_points = scene.num_points if "points" in parts else 0
    pieces, line = line_pieces(scene) if "lines" in parts else (np.zeros((0, 2, 3)), np.zeros(0, np.int64))
    polygons, members = plane_patches(scene) if "planes" in parts else ([], np.zeros(0, np.int64))
    colours = scene.points.color[:num_points]
    return Drawn(
        points=scene.points.xyz[:num_points],
        point_colours=colours if colours.any() else np.full_like(colours, _POINT_GREY),
        pieces=pieces,
        piece_colours=_line_colours(scene)[line],
        piece_line=line,
        polygons=polygons,
        polygon_colours=PALETTE[patch_groups(members)],
        plane_ids=scene.planes.ids.tolist()[: len(polygons)],
    )


def drawn_cameras(scene: Scene) -> DrawnCameras:
    """Return the cameras of a scene."""
    world_from_cam = se3.to_matrix(se3.inverse(scene.cam_from_world))
    opening, aspect = openings(scene)
    return DrawnCameras(
        scene.images.names, world_from_cam, opening, aspect, up_of(scene), _depth(world_from_cam[:, :3, 3])
    )


def middle_of(geometry: Drawn, shown: DrawnCameras) -> FloatArray:
    """Return a place (3,) in the middle of a scene: near to it, numbers in single precision have digits enough."""
    places = np.concatenate([geometry.places, shown.world_from_cam[:, :3, 3]])
    known = places[np.isfinite(places).all(axis=1)]
    return np.asarray(np.median(known, axis=0), np.float64) if len(known) else np.zeros(3)


def openings(scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Return the vertical opening of each image in radians, and width over height."""
    opening, aspect = np.full(scene.num_cameras, 0.8), np.full(scene.num_cameras, 4 / 3)
    for index in range(scene.num_cameras):
        width, height = float(scene.cameras.width[index]), float(scene.cameras.height[index])
        if not (width > 0 and height > 0):
            continue
        model = cameras.model(scene.cameras.models[index])
        params = np.ascontiguousarray(scene.cameras.params[index, : model.num_parameters])
        edges = np.array([[0.5 * width, 0.0], [0.5 * width, height], [0.0, 0.5 * height], [width, 0.5 * height]])
        bearings = model.unproject(params, edges)
        if np.isfinite(bearings).all():
            up, down, left, right = np.minimum(np.arccos(np.clip(bearings[:, 2], -1.0, 1.0)), _WIDEST)
            opening[index] = up + down
            aspect[index] = np.tan(0.5 * (left + right)) / np.tan(0.5 * (up + down))
    return opening[scene.images.camera_idx], aspect[scene.images.camera_idx]


def typical_gap(centers: FloatArray) -> float:
    """Return the median distance of at least two cameras from their nearest neighbours."""
    from scipy.spatial import KDTree

    return float(np.median(KDTree(centers).query(centers, k=2)[0][:, 1]))


def light(colours: npt.ArrayLike) -> FloatArray:
    """Return linear intensities from 0 to 1 of sRGB colours in bytes."""
    share = np.asarray(colours, float) / 255.0
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def _depth(centers: FloatArray) -> float:
    if len(centers) < 2:
        return 1.0
    gap = typical_gap(centers)
    extent = float(np.linalg.norm(np.subtract(*np.percentile(centers, [95, 5], axis=0))))
    return float(np.clip(0.4 * gap, 0.005 * extent, 0.1 * extent)) or 1.0


def _line_colours(scene: Scene) -> Colours:
    """One colour per shared direction."""
    direction = direction_of_lines(scene)
    return np.where((direction >= 0)[:, None], PALETTE[direction % len(PALETTE)], np.array(_LINE_COLOUR, np.uint8))


def direction_of_lines(scene: Scene) -> IntArray:
    """Return the direction that each line follows (L,), -1 for none."""
    direction = np.full(scene.num_lines, -1, np.int64)
    line, along = scene.relations.line_along_direction.T
    direction[line] = along
    return direction
