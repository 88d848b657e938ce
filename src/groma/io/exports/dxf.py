# SPDX-License-Identifier: BSD-3-Clause
"""DXF files for architects and surveyors: lines, planes as polygons, points and cameras on layers of their own.

ASCII DXF of AutoCAD R12 (AC1009), which every CAD program reads. Coordinates are those of the scene, in double
precision and scene units. Lines of a shared direction are on a layer ``LINES_n`` with the identifier of the direction,
all others on ``LINES``; every plane is a closed 3D polyline on ``PLANES``; points on ``POINTS``; on ``CAMERAS`` a point
and a frustum for each image.

Reference: Autodesk, *AutoCAD R12 DXF Reference*, 1992.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator

import numpy as np

from groma._typing import FloatArray
from groma.errors import InputError
from groma.io.atomic import atomic_output
from groma.io.drawn import Drawn, direction_of_lines, drawn, drawn_cameras
from groma.io.registry import SceneFormat, register_format
from groma.scene import Scene
from groma.scene.checks import check_scene_given

#: Numbers of AutoCAD's colours: red, green, blue, yellow, magenta, cyan; 7 is black on white and 8 is grey.
_DIRECTION_COLOURS = (1, 5, 3, 30, 6, 4, 2, 34)
_LAYERS = (("POINTS", 8), ("LINES", 7), ("PLANES", 140), ("CAMERAS", 8))
#: A polyline in space that is closed, and a vertex of one.
_CLOSED_IN_SPACE, _VERTEX_IN_SPACE = 9, 32

#: A group: code and value.
Group = tuple[int, str | int | float]


def write_dxf(scene: Scene, path: str | os.PathLike[str], force: bool = False) -> None:
    """Write points, lines, planes and cameras as an ASCII DXF file (R12).

    Parameters
    ----------
    scene : Scene
        What to write.
    path : path
        The file.
    force : bool
        Replace an existing file.
    """
    check_scene_given(scene)
    check_dxf(scene)
    with atomic_output(path, force) as draft, draft.open("w", encoding="ascii", newline="\r\n") as file:
        for code, value in _groups(scene):
            file.write(f"{code:3d}\n{value!r}\n" if isinstance(value, float) else f"{code:3d}\n{value}\n")


def check_dxf(scene: Scene) -> None:
    """Raise InputError if there is nothing to draw, or if it is not finite."""
    if not (scene.num_points or scene.num_lines or scene.num_planes or scene.num_images):
        raise InputError("The scene has no points, lines, planes or images: there is nothing to draw.")


def _groups(scene: Scene) -> Iterator[Group]:
    geometry, frusta = drawn(scene), drawn_cameras(scene).frusta().reshape(-1, 2, 3)
    shared = [f"LINES_{number}" for number in scene.directions.ids.tolist()]
    colours = [_DIRECTION_COLOURS[k % len(_DIRECTION_COLOURS)] for k in range(len(shared))]
    layers = [*_LAYERS, *zip(shared, colours, strict=True)]
    yield from _header(np.concatenate([geometry.places, frusta.reshape(-1, 3)]))
    yield from _tables(layers)
    yield from [(0, "SECTION"), (2, "ENTITIES")]
    yield from _points("POINTS", geometry.points)
    names = np.array([*shared, "LINES"])[direction_of_lines(scene)[geometry.piece_line]] if len(geometry.pieces) else ()
    yield from _strokes(names, geometry.pieces)
    yield from _polygons(geometry)
    yield from _points("CAMERAS", scene.cam_centers_in_world)
    yield from _strokes(["CAMERAS"] * len(frusta), frusta)
    yield from [(0, "ENDSEC"), (0, "EOF")]


def _header(places: FloatArray) -> Iterator[Group]:
    known = places[np.isfinite(places).all(axis=1)]
    low, high = (known.min(axis=0), known.max(axis=0)) if len(known) else (np.zeros(3), np.zeros(3))
    yield from [(0, "SECTION"), (2, "HEADER"), (9, "$ACADVER"), (1, "AC1009")]
    for name, place in (("$EXTMIN", low), ("$EXTMAX", high)):
        yield from [(9, name), *_place(place.tolist())]
    yield (0, "ENDSEC")


def _tables(layers: Iterable[tuple[str, int]]) -> Iterator[Group]:
    layers = list(layers)
    yield from [(0, "SECTION"), (2, "TABLES"), (0, "TABLE"), (2, "LTYPE"), (70, 1)]
    yield from [(0, "LTYPE"), (2, "CONTINUOUS"), (70, 0), (3, "Solid line"), (72, 65), (73, 0), (40, 0.0)]
    yield from [(0, "ENDTAB"), (0, "TABLE"), (2, "LAYER"), (70, len(layers))]
    for name, colour in layers:
        yield from [(0, "LAYER"), (2, name), (70, 0), (62, colour), (6, "CONTINUOUS")]
    yield from [(0, "ENDTAB"), (0, "ENDSEC")]


def _place(place: list[float], first: int = 10) -> Iterator[Group]:
    return ((first + 10 * axis, float(value)) for axis, value in enumerate(place))


def _points(layer: str, places: FloatArray) -> Iterator[Group]:
    for place in places[np.isfinite(places).all(axis=1)].tolist():
        yield from [(0, "POINT"), (8, layer), *_place(place)]


def _strokes(layers: Iterable[str], pieces: FloatArray) -> Iterator[Group]:
    for layer, (start, end) in zip(layers, pieces.tolist(), strict=True):
        if np.isfinite(start).all() and np.isfinite(end).all():
            yield from [(0, "LINE"), (8, str(layer)), *_place(start), *_place(end, 11)]


def _polygons(geometry: Drawn) -> Iterator[Group]:
    for polygon in geometry.polygons:
        yield from [(0, "POLYLINE"), (8, "PLANES"), (66, 1), *_place([0.0, 0.0, 0.0]), (70, _CLOSED_IN_SPACE)]
        for corner in polygon.tolist():
            yield from [(0, "VERTEX"), (8, "PLANES"), *_place(corner), (70, _VERTEX_IN_SPACE)]
        yield from [(0, "SEQEND"), (8, "PLANES")]


register_format(SceneFormat("dxf", target=".dxf", endings=(".dxf",), write=write_dxf, check=check_dxf))
