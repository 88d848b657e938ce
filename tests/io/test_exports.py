# SPDX-License-Identifier: BSD-3-Clause
"""glTF, DXF, recordings for rerun, OBJ and PLY: read back by trimesh, ezdxf, rerun and Open3D, those that are there."""

import importlib.util
import json
import struct
from collections import Counter

import numpy as np
import pytest

from groma import cameras
from groma.cli.main import run
from groma.errors import InputError, OutputError
from groma.geometry import se3
from groma.io import write_dxf, write_gltf, write_obj, write_ply, write_recording, write_scene
from groma.io.drawn import drawn_cameras
from groma.scene import Scene, synthetic
from groma.scene.patches import patch_area, plane_patches


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Far from the origin, as surveyed coordinates are."""
    near = synthetic.holistic(10, seed=2).truth
    return near.transformed(np.array([0, 0, 0, 1, 4.0e5, 5.2e6, 300.0, 1.0]))


# -------------------------------------------------------------------------------------------------------------- glTF


def _document(path) -> tuple[dict, bytes]:
    """The parts of a binary glTF file, by the specification alone."""
    raw = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", raw)
    assert (magic, version, length) == (b"glTF", 2, len(raw))
    size, kind = struct.unpack_from("<I4s", raw, 12)
    assert kind == b"JSON" and size % 4 == 0
    data_size, data_kind = struct.unpack_from("<I4s", raw, 20 + size)
    assert data_kind == b"BIN\0" and 28 + size + data_size == length
    return json.loads(raw[20 : 20 + size]), raw[28 + size :]


def _turned(quaternion, vectors: np.ndarray) -> np.ndarray:
    axis, w = np.array(quaternion[:3]), quaternion[3]
    return vectors + 2 * np.cross(axis, np.cross(axis, vectors) + w * vectors)


@pytest.mark.parametrize("name", ["scene.glb", "scene.gltf"])
def test_gltf_read_by_trimesh(scene, tmp_path, name):
    trimesh = pytest.importorskip("trimesh")
    write_scene(scene, tmp_path / name)
    found = trimesh.load_scene(tmp_path / name)
    read = {node: found.geometry[found.graph[node][1]] for node in found.graph.nodes_geometry}
    names = {"points", "lines", "frusta", *(f"plane {number}" for number in scene.planes.ids)}
    assert set(read) == set(found.geometry) == names  # by node, and by mesh
    text = (tmp_path / name).read_text() if name.endswith("gltf") else json.dumps(_document(tmp_path / name)[0])
    shift = np.array(json.loads(text)["nodes"][0]["extras"]["shift"])
    assert np.linalg.norm(shift) > 1e6
    reach = np.ptp(scene.points.xyz, axis=0).max()
    np.testing.assert_allclose(read["points"].vertices + shift, scene.points.xyz, rtol=0, atol=1e-6 * reach)
    assert json.loads(text)["meshes"][1]["primitives"][0]["mode"] == 1  # pairs; trimesh joins them to one curve
    ends = read["lines"].vertices.reshape(-1, 2, 3)
    np.testing.assert_allclose(ends + shift, scene.lines.segments, rtol=0, atol=1e-6 * reach)
    for number, patch in zip(scene.planes.ids, plane_patches(scene)[0], strict=True):
        assert read[f"plane {number}"].area == pytest.approx(patch_area(patch - patch[0]), rel=1e-5)


def test_cameras_of_gltf_look_where_ours_look(scene, tmp_path):
    write_gltf(scene, tmp_path / "scene.glb")
    document, _ = _document(tmp_path / "scene.glb")
    top, nodes = document["nodes"][0], {node["name"]: node for node in document["nodes"] if "camera" in node}
    shift = np.array(top["extras"]["shift"])
    assert list(nodes) == list(scene.images.names)
    for image, name in enumerate(scene.images.names):
        matrix = np.array(nodes[name]["matrix"]).reshape(4, 4).T  # by columns
        rotation = se3.to_matrix(scene.cam_from_world[image : image + 1])[0][:3, :3]
        np.testing.assert_allclose(-matrix[:3, 2], rotation[2], atol=1e-9)  # forward
        np.testing.assert_allclose(-matrix[:3, 1], rotation[1], atol=1e-9)  # down
        np.testing.assert_allclose(matrix[:3, 3] + shift, scene.cam_centers_in_world[image], rtol=0, atol=1e-6)
        lens = document["cameras"][nodes[name]["camera"]]["perspective"]
        camera = scene.images.camera_idx[image]
        width, height = scene.cameras.width[camera], scene.cameras.height[camera]
        assert lens["yfov"] == pytest.approx(2 * np.arctan(0.5 * height / scene.cameras.params[camera, 0]), rel=0.05)
        assert lens["aspectRatio"] == pytest.approx(width / height, rel=0.05)
    # What is up in the photographs is +y.
    down = np.mean([se3.to_matrix(pose[None])[0][1, :3] for pose in scene.cam_from_world], axis=0)
    np.testing.assert_allclose(_turned(top["rotation"], -down / np.linalg.norm(down)), [0, 1, 0], atol=1e-6)


def test_accessors_of_gltf_hold_what_they_say(scene, tmp_path):
    """Bounds, alignment and counts, which viewers rely on."""
    write_gltf(scene, tmp_path / "scene.glb")
    document, data = _document(tmp_path / "scene.glb")
    assert document["buffers"] == [{"byteLength": len(data)}]
    sizes = {5121: 1, 5125: 4, 5126: 4}
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0 and view["byteOffset"] + view["byteLength"] <= len(data)
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        assert view["byteLength"] == accessor["count"] * width * sizes[accessor["componentType"]]
        if "min" in accessor:
            rows = np.frombuffer(data, "<f4", 3 * accessor["count"], view["byteOffset"]).reshape(-1, 3)
            np.testing.assert_array_equal([rows.min(axis=0), rows.max(axis=0)], [accessor["min"], accessor["max"]])


# --------------------------------------------------------------------------------------------------------------- DXF


def _entities(path) -> list[list[tuple[int, str]]]:
    """The entities of an ASCII DXF file, each as its groups, by the reference alone."""
    lines = path.read_text().splitlines()
    groups = [(int(code), value) for code, value in zip(lines[::2], lines[1::2], strict=True)]
    assert groups[-1] == (0, "EOF")
    begin = groups.index((2, "ENTITIES")) + 1
    found: list[list[tuple[int, str]]] = []
    for group in groups[begin:-2]:
        found += [[]] if group[0] == 0 else []
        found[-1].append(group)
    return found


def _place(entity, first: int = 10) -> list[float]:
    return [float(value) for code, value in entity if code in (first, first + 10, first + 20)]


def test_dxf_by_its_groups(scene, tmp_path):
    write_scene(scene, tmp_path / "scene.dxf")
    entities = _entities(tmp_path / "scene.dxf")
    of = lambda kind, layer: [one for one in entities if one[0][1] == kind and (8, layer) in one]  # noqa: E731
    np.testing.assert_array_equal([_place(one) for one in of("POINT", "POINTS")], scene.points.xyz)  # every digit
    np.testing.assert_array_equal([_place(one) for one in of("POINT", "CAMERAS")], scene.cam_centers_in_world)
    line, direction = scene.relations.line_along_direction.T
    for number, identifier in enumerate(scene.directions.ids):
        ends = np.array([[_place(one), _place(one, 11)] for one in of("LINE", f"LINES_{identifier}")])
        np.testing.assert_array_equal(ends, scene.lines.segments[np.sort(line[direction == number])])
    assert len(of("LINE", "LINES")) == scene.num_lines - len(np.unique(line))
    assert len(of("POLYLINE", "PLANES")) == len(of("SEQEND", "PLANES")) == scene.num_planes
    corners = [_place(one) for one in of("VERTEX", "PLANES")]
    np.testing.assert_array_equal(corners, np.concatenate(plane_patches(scene)[0]))


def test_dxf_read_by_ezdxf(scene, tmp_path):
    ezdxf = pytest.importorskip("ezdxf")
    write_dxf(scene, tmp_path / "scene.dxf")
    drawing = ezdxf.readfile(tmp_path / "scene.dxf")
    audit = drawing.audit()
    assert drawing.dxfversion == "AC1009" and not audit.errors and not audit.fixes
    kinds = Counter((entity.dxftype(), entity.dxf.layer) for entity in drawing.modelspace())
    assert kinds["POLYLINE", "PLANES"] == scene.num_planes and kinds["POINT", "POINTS"] == scene.num_points
    layers = {layer.dxf.name for layer in drawing.layers}
    assert {"POINTS", "LINES", "PLANES", "CAMERAS", *(f"LINES_{number}" for number in scene.directions.ids)} <= layers
    polygon = next(iter(drawing.modelspace().query("POLYLINE")))
    assert polygon.is_3d_polyline and polygon.is_closed
    np.testing.assert_array_equal([list(place) for place in polygon.points()], plane_patches(scene)[0][0])
    np.testing.assert_array_equal(list(drawing.header["$EXTMIN"]), np.min(_places(scene), axis=0))


def _places(scene: Scene) -> np.ndarray:
    parts = [scene.points.xyz, scene.lines.segments.reshape(-1, 3), *plane_patches(scene)[0]]
    return np.concatenate([*parts, drawn_cameras(scene).frusta().reshape(-1, 3)])


# --------------------------------------------------------------------------------------------------------- Recordings


def test_a_recording_read_by_rerun(scene, tmp_path):
    pytest.importorskip("rerun", reason='needs rerun: pip install "groma[rerun]"')
    reader = pytest.importorskip("rerun.chunk").RrdReader
    write_scene(scene, tmp_path / "scene.rrd")
    columns: dict[str, dict[str, list]] = {}
    for chunk in reader(str(tmp_path / "scene.rrd")).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            columns.setdefault(str(chunk.entity_path), {}).setdefault(name, []).extend(batch.column(name).to_pylist())
    (shift,) = (np.ravel(values[0]) for name, values in columns["/world"].items() if name.endswith("shift"))
    reach = np.ptp(scene.points.xyz, axis=0).max()
    places = np.array(columns["/world/points"]["Points3D:positions"][0]) + shift
    np.testing.assert_allclose(places, scene.points.xyz, rtol=0, atol=1e-6 * reach)
    assert np.shape(columns["/world/lines"]["LineStrips3D:strips"][0]) == (scene.num_lines, 2, 3)
    assert {f"/world/planes/{number}" for number in scene.planes.ids} <= set(columns)
    name = scene.images.names[3]
    (entity,) = (entity for entity in columns if entity.endswith((name.replace(".", r"\."), name)))
    assert {"Transform3D:translation", "Pinhole:image_from_camera"} <= set(columns[entity])
    seen = scene.point_observations.pixel[scene.point_observations.image_idx == 3]
    assert np.allclose(columns[f"{entity}/points"]["Points2D:positions"][0], seen, atol=1e-3)


@pytest.mark.skipif(importlib.util.find_spec("rerun") is not None, reason="rerun is installed")
def test_without_rerun_a_sentence_says_what_to_install(scene, tmp_path, capsys):
    with pytest.raises(InputError, match=r"pip install \"groma\[rerun\]\""):
        write_recording(scene, tmp_path / "scene.rrd")
    write_scene(scene, tmp_path / "scene.npz")
    assert run(["convert", str(tmp_path / "scene.npz"), str(tmp_path / "scene.rrd")]) == 1
    assert "groma[rerun]" in capsys.readouterr().err and not (tmp_path / "scene.rrd").exists()


# --------------------------------------------------------------------------------------------------------- OBJ and PLY


@pytest.mark.parametrize("write", [write_obj, write_ply])
def test_planes_read_by_trimesh(scene, tmp_path, write):
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / f"scene.{write.__name__.removeprefix('write_')}"
    write(scene, path)
    found = trimesh.load_mesh(path)
    area = sum(patch_area(patch - patch[0]) for patch in plane_patches(scene)[0])
    assert found.area == pytest.approx(area, rel=1e-6)


def test_read_by_open3d(scene, tmp_path):
    open3d = pytest.importorskip("open3d", reason="needs Open3D")
    write_obj(scene, tmp_path / "scene.obj")
    write_ply(scene, tmp_path / "scene.ply")
    faces = sum(len(patch) - 2 for patch in plane_patches(scene)[0])
    assert len(open3d.io.read_triangle_mesh(str(tmp_path / "scene.obj")).triangles) == faces
    assert len(open3d.io.read_triangle_mesh(str(tmp_path / "scene.ply")).triangles) == faces
    lines = open3d.io.read_line_set(str(tmp_path / "scene.ply"))
    np.testing.assert_array_equal(np.asarray(lines.points)[np.asarray(lines.lines)], scene.lines.segments)


# ------------------------------------------------------------------------------------------------------------- Common


@pytest.mark.parametrize("name", ["scene.glb", "scene.gltf", "scene.dxf"])
def test_files_are_not_replaced_unasked(scene, tmp_path, name):
    write_scene(scene, tmp_path / name)
    before = (tmp_path / name).read_bytes()
    with pytest.raises(OutputError, match="exists"):
        write_scene(scene, tmp_path / name)
    write_scene(scene, tmp_path / name, force=True)
    assert (tmp_path / name).read_bytes() == before  # the same scene gives the same bytes


@pytest.mark.parametrize("parts", ["images", "points", "lines"])
def test_scenes_of_one_kind(scene, tmp_path, parts):
    """Files with little in them are valid, too."""
    trimesh = pytest.importorskip("trimesh")
    wanted = {
        "images": scene.keep(points=[], lines=[], planes=[]),
        "points": Scene(points=scene.points),
        "lines": Scene(lines=scene.lines),
    }[parts]
    write_gltf(wanted, tmp_path / "one.glb")
    assert len(trimesh.load_scene(tmp_path / "one.glb").geometry) == 1
    write_dxf(wanted, tmp_path / "one.dxf")
    assert _entities(tmp_path / "one.dxf")


def test_an_empty_scene(tmp_path):
    write_gltf(Scene(), tmp_path / "empty.gltf")
    assert json.loads((tmp_path / "empty.gltf").read_text())["asset"]["version"] == "2.0"
    with pytest.raises(InputError, match="nothing to draw"):
        write_dxf(Scene(), tmp_path / "empty.dxf")


def test_frusta_reach_to_the_borders_of_the_picture():
    scene = synthetic.holistic(6, seed=1).truth
    shown = drawn_cameras(scene)
    for image, corners in enumerate(shown.corners()):
        pose = se3.to_matrix(scene.cam_from_world[image : image + 1])[0]
        camera = scene.images.camera_idx[image]
        model = cameras.model(scene.cameras.models[camera])
        params = np.ascontiguousarray(scene.cameras.params[camera, : model.num_parameters])
        pixels = model.project(params, np.ascontiguousarray(corners @ pose[:3, :3].T + pose[:3, 3]))
        width, height = scene.cameras.width[camera], scene.cameras.height[camera]
        np.testing.assert_allclose(pixels, [[0, 0], [width, 0], [width, height], [0, height]], atol=0.05 * width)
