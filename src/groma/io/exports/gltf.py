# SPDX-License-Identifier: BSD-3-Clause
"""glTF 2.0 files: points, lines, planes and cameras for Blender, web pages and viewers of every kind.

``.glb`` is one binary file, ``.gltf`` is JSON with the numbers inside. The node ``scene`` turns up to
+y, as glTF has it, and shifts the scene to its middle, because numbers are in single precision; its
``extras`` hold the shift. Below it every plane is a node of its own, and every image is a node with a camera.

Reference: Khronos Group, *glTF 2.0 Specification*, 2021. There cameras look along -z with y up.
"""

from __future__ import annotations

import base64
import json
import os
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray
from groma.io.atomic import atomic_output
from groma.io.drawn import Colours, DrawnCameras, drawn, drawn_cameras, light, middle_of
from groma.io.registry import SceneFormat, register_format
from groma.scene import Scene
from groma.scene.checks import check_scene_given
from groma.scene.patches import triangle_fans

_FLOAT, _UNSIGNED_BYTE, _UNSIGNED_INT = 5126, 5121, 5125
_POINTS, _LINES, _TRIANGLES = 0, 1, 4
_ARRAY, _ELEMENTS = 34962, 34963
#: How much of what lies behind them planes hide.
_PLANE_ALPHA = 0.45
_CAMERA_COLOUR = (60, 66, 74)
#: From the camera of glTF (along -z, y up) to ours (along z, y down).
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass
class _Document:
    """A glTF document as it grows."""

    content: dict[str, Any]
    data: bytearray = field(default_factory=bytearray)

    def add(self, kind: str, entry: dict[str, Any]) -> int:
        """Append to a list of the document; return the place."""
        entries = self.content.setdefault(kind, [])
        entries.append(entry)
        return len(entries) - 1

    def accessor(self, values: npt.NDArray[Any], shape: str, target: int, **more: Any) -> int:
        """Append numbers; return their accessor."""
        kinds = {"f": _FLOAT, "u1": _UNSIGNED_BYTE, "u4": _UNSIGNED_INT}
        kind = kinds["f" if values.dtype.kind == "f" else values.dtype.str[1:]]
        raw = np.ascontiguousarray(values).tobytes()
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(raw), "target": target}
        self.data += raw + b"\0" * (-len(raw) % 4)
        entry = {"bufferView": self.add("bufferViews", view), "componentType": kind, "count": len(values)}
        return self.add("accessors", {**entry, "type": shape, **more})

    def mesh(
        self, places: FloatArray, mode: int, material: int, colours: Colours | None = None, rows: Any = None
    ) -> int:
        """Append vertices (n, 3), with colours (n, 3) and what joins them, as a mesh; return it."""
        single = np.asarray(places, "<f4")
        box = {"min": single.min(axis=0).tolist(), "max": single.max(axis=0).tolist()}
        parts: dict[str, Any] = {
            "attributes": {"POSITION": self.accessor(single, "VEC3", _ARRAY, **box)},
            "mode": mode,
            "material": material,
        }
        if colours is not None:
            opaque = np.column_stack([colours, np.full(len(colours), 255, np.uint8)])
            parts["attributes"]["COLOR_0"] = self.accessor(opaque, "VEC4", _ARRAY, normalized=True)
        if rows is not None:
            parts["indices"] = self.accessor(np.asarray(rows, "<u4").ravel(), "SCALAR", _ELEMENTS)
        return self.add("meshes", {"primitives": [parts]})


def write_gltf(scene: Scene, path: str | os.PathLike[str], force: bool = False) -> None:
    """Write points, lines, planes and cameras as a glTF 2.0 file: ``.glb`` binary, ``.gltf`` as text.

    Parameters
    ----------
    scene : Scene
        What to write.
    path : path
        The file; the ending decides on the form.
    force : bool
        Replace an existing file.
    """
    check_scene_given(scene)
    document, as_text = _document(scene), Path(path).suffix.lower() == ".gltf"
    if as_text and document.data:
        inside = "data:application/octet-stream;base64," + base64.b64encode(document.data).decode()
        document.content["buffers"][0]["uri"] = inside
    text = json.dumps(document.content, separators=(",", ":"), allow_nan=False).encode()
    with atomic_output(path, force) as draft:
        draft.write_bytes(text if as_text else _binary(text, bytes(document.data)))


def _document(scene: Scene) -> _Document:
    geometry, shown = drawn(scene), drawn_cameras(scene)
    shift = middle_of(geometry, shown)
    top = {"name": "scene", "rotation": _upright(shown), "children": [], "extras": {"shift": shift.tolist()}}
    document = _Document({"asset": {"version": "2.0", "generator": "groma"}, "scene": 0, "scenes": [{"nodes": [0]}]})
    document.add("nodes", top)

    def node(**entry: Any) -> None:
        if "mesh" in entry:  # readers name geometry by node or by mesh
            document.content["meshes"][entry["mesh"]]["name"] = entry["name"]
        top["children"].append(document.add("nodes", entry))

    plain = document.add("materials", {"name": "colours", "extensions": {"KHR_materials_unlit": {}}})
    document.content["extensionsUsed"] = ["KHR_materials_unlit"]
    points = np.isfinite(geometry.points).all(axis=1)
    if points.any():
        mesh = document.mesh(geometry.points[points] - shift, _POINTS, plain, geometry.point_colours[points])
        node(name="points", mesh=mesh)
    if len(geometry.pieces):
        ends, colours = geometry.pieces.reshape(-1, 3) - shift, np.repeat(geometry.piece_colours, 2, axis=0)
        node(name="lines", mesh=document.mesh(ends, _LINES, plain, colours))
    materials: dict[tuple[int, ...], int] = {}
    for number, polygon, colour in zip(
        geometry.plane_ids, geometry.polygons, geometry.polygon_colours.tolist(), strict=True
    ):
        if tuple(colour) not in materials:
            materials[tuple(colour)] = document.add("materials", _glass(colour))
        mesh = document.mesh(polygon - shift, _TRIANGLES, materials[tuple(colour)], rows=triangle_fans([polygon])[1])
        node(name=f"plane {number}", mesh=mesh)
    if shown.names:
        strokes = shown.frusta().reshape(-1, 3) - shift
        colours = np.tile(np.array(_CAMERA_COLOUR, np.uint8), (len(strokes), 1))
        node(name="frusta", mesh=document.mesh(strokes, _LINES, plain, colours))
    _add_cameras(document, shown, shift, node)
    _finish(document)
    return document


def _add_cameras(document: _Document, shown: DrawnCameras, shift: FloatArray, node: Any) -> None:
    for name, pose, opening, aspect in zip(
        shown.names, shown.world_from_cam, shown.opening.tolist(), shown.aspect.tolist(), strict=True
    ):
        lens = {"yfov": opening, "aspectRatio": aspect, "znear": 0.1 * shown.depth}
        moved = pose @ _FLIP
        moved[:3, 3] -= shift
        camera = document.add("cameras", {"name": name, "type": "perspective", "perspective": lens})
        node(name=name, camera=camera, matrix=moved.T.ravel().tolist())  # by columns


def _finish(document: _Document) -> None:
    if not document.data:  # a buffer must not be empty, and lists neither
        for kind in ("buffers", "materials"):
            document.content.pop(kind, None)
        document.content.pop("extensionsUsed", None)
    else:
        document.content["buffers"] = [{"byteLength": len(document.data)}]
    if not document.content["nodes"][0]["children"]:
        del document.content["nodes"][0]["children"]


def _glass(colour: list[int]) -> dict[str, Any]:
    """A material seen from both sides that shows what lies behind it; glTF takes colours as amounts of light."""
    return {
        "pbrMetallicRoughness": {"baseColorFactor": [*light(colour).tolist(), _PLANE_ALPHA], "metallicFactor": 0.0},
        "alphaMode": "BLEND",
        "doubleSided": True,
    }


def _upright(shown: DrawnCameras) -> list[float]:
    """Return the quaternion [x y z w] that turns up to +y."""
    up = shown.up
    axis = np.cross(up, [0.0, 1.0, 0.0])
    if up[1] < -1.0 + 1e-12:
        return [1.0, 0.0, 0.0, 0.0]
    quaternion = np.array([*axis, 1.0 + up[1]])
    return (quaternion / np.linalg.norm(quaternion)).tolist()


def _binary(text: bytes, data: bytes) -> bytes:
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    if data:
        chunks += struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


register_format(SceneFormat("gltf", target=".glb or .gltf for glTF", endings=(".glb", ".gltf"), write=write_gltf))
