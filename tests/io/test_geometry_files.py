# SPDX-License-Identifier: BSD-3-Clause
"""PLY and OBJ files: what they hold, read back by an independent reader; choice of parts; refusals; planes cut up."""

import numpy as np
import pytest

from groma.errors import InputError, OutputError
from groma.io import write_geometry, write_obj, write_ply, write_scene
from groma.io.reference import read_reference
from groma.scene import Scene, synthetic
from groma.scene.patches import PALETTE, patch_area, patch_groups, plane_patches, triangle_fans


@pytest.fixture(scope="module")
def scene() -> Scene:
    return synthetic.holistic(10, seed=2).truth


def _read_ply(path) -> dict[str, np.ndarray]:
    """A reader of its own, led by the header alone."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    types = {"double": "<f8", "uchar": "u1", "int": "<i4"}
    tables: dict[str, tuple[int, list]] = {}
    for words in (line.split() for line in head.decode("ascii").splitlines()):
        if words[0] == "element":
            tables[words[1]] = (int(words[2]), [])
        elif words[0] == "property" and words[1] == "list":
            fields = tables[next(reversed(tables))][1]
            fields += [("count", types[words[2]]), (words[4], types[words[3]], 3)]
        elif words[0] == "property":
            tables[next(reversed(tables))][1].append((words[2], types[words[1]]))
    found, at = {}, 0
    for name, (count, fields) in tables.items():
        found[name] = np.frombuffer(body, np.dtype(fields), count, at)
        at += found[name].nbytes
    assert at == len(body)
    return found


def _places(vertices) -> np.ndarray:
    return np.stack([vertices[axis] for axis in "xyz"], axis=1)


def test_ply_holds_points_lines_and_planes(scene, tmp_path):
    write_ply(scene, tmp_path / "all.ply")
    found = _read_ply(tmp_path / "all.ply")
    places = _places(found["vertex"])
    np.testing.assert_array_equal(places[: scene.num_points], scene.points.xyz)
    ends = np.stack([found["edge"]["vertex1"], found["edge"]["vertex2"]], axis=1)
    np.testing.assert_array_equal(places[ends], scene.lines.segments)
    faces = found["face"]["vertex_indices"]
    assert (found["face"]["count"] == 3).all()
    assert faces.min() == scene.num_points + 2 * scene.num_lines and faces.max() == len(places) - 1
    # Every corner of every triangle lies on a plane, and together they are as large as the patches.
    distance = np.abs(places[faces] @ scene.planes.hesse[:, :3].T + scene.planes.hesse[:, 3])
    assert distance.max(axis=1).min(axis=1).max() < 1e-9
    first, second = places[faces[:, 1]] - places[faces[:, 0]], places[faces[:, 2]] - places[faces[:, 0]]
    area = 0.5 * np.linalg.norm(np.cross(first, second), axis=1).sum()
    assert area == pytest.approx(sum(patch_area(patch) for patch in plane_patches(scene)[0]))


@pytest.mark.parametrize(("part", "vertices"), [("points", 1), ("lines", 2), ("planes", 0)])
def test_one_part_alone(scene, tmp_path, part, vertices):
    write_ply(scene, tmp_path / "part.ply", parts=(part,))
    found = _read_ply(tmp_path / "part.ply")
    counts = {
        "points": scene.num_points,
        "lines": 2 * scene.num_lines,
        "planes": sum(map(len, plane_patches(scene)[0])),
    }
    assert len(found["vertex"]) == counts[part]
    assert len(found["edge"]) == (scene.num_lines if part == "lines" else 0)
    assert ("face" in found) == (part == "planes")
    write_obj(scene, tmp_path / "part.obj", parts=(part,))
    kinds = {row.split()[0] for row in (tmp_path / "part.obj").read_text().splitlines()}
    assert kinds == {"v", "o", {"points": "p", "lines": "l", "planes": "f"}[part]}


def test_obj_holds_points_lines_and_planes(scene, tmp_path):
    write_obj(scene, tmp_path / "all.obj")
    rows = [row.split() for row in (tmp_path / "all.obj").read_text().splitlines()]
    table = {kind: [row[1:] for row in rows if row[0] == kind] for kind in "vplfo"}
    places = np.array(table["v"], float)
    assert places.shape[1] == 6 and (places[:, 3:] >= 0).all() and (places[:, 3:] <= 1).all()
    np.testing.assert_array_equal(places[np.array(table["p"], int)[:, 0] - 1, :3], scene.points.xyz)
    np.testing.assert_array_equal(places[np.array(table["l"], int) - 1, :3], scene.lines.segments)
    faces = iter(table["f"])
    for patch in plane_patches(scene)[0]:  # a fan of triangles around each
        fan = np.array([next(faces) for _ in range(len(patch) - 2)], int) - 1
        assert (fan[:, 0] == fan[0, 0]).all() and (fan[1:, 1] == fan[:-1, 2]).all()
        np.testing.assert_array_equal(places[[*fan[0], *fan[1:, 2]], :3], patch)
    assert next(faces, None) is None
    assert [name for (name,) in table["o"]] == ["points", "lines", *(f"plane_{number}" for number in scene.planes.ids)]


def test_colours_tell_planes_and_directions_apart(scene, tmp_path):
    write_ply(scene, tmp_path / "all.ply")
    vertices = _read_ply(tmp_path / "all.ply")["vertex"]
    colours = np.stack([vertices[name] for name in ("red", "green", "blue")], axis=1)
    np.testing.assert_array_equal(colours[: scene.num_points], 128)  # none is known
    at = scene.num_points + 2 * scene.num_lines
    patches, members = plane_patches(scene)
    for patch, group in zip(patches, patch_groups(members), strict=True):
        assert (colours[at : at + len(patch)] == PALETTE[group]).all()
        at += len(patch)
    line, direction = scene.relations.line_along_direction.T
    np.testing.assert_array_equal(colours[scene.num_points + 2 * line], PALETTE[direction % len(PALETTE)])


def test_files_serve_as_references(scene, tmp_path):
    write_ply(scene, tmp_path / "lines.ply", parts=("lines",))
    write_ply(scene, tmp_path / "planes.ply", parts=("planes",))
    np.testing.assert_array_equal(read_reference(tmp_path / "lines.ply").segments, scene.lines.segments)
    assert len(read_reference(tmp_path / "planes.ply").triangles)


def test_files_of_a_map(scene, tmp_path):
    assert write_geometry(scene, tmp_path) == ("lines.ply", "lines.obj", "planes.ply")
    assert len(_read_ply(tmp_path / "lines.ply")["edge"]) == scene.num_lines
    assert set(_read_ply(tmp_path / "planes.ply")) == {"vertex", "face", "edge"}
    assert write_geometry(scene.points_only(), tmp_path) == ()


@pytest.mark.parametrize("name", ["empty.ply", "empty.obj"])
def test_nothing_is_a_file_too(tmp_path, name):
    write_scene(Scene(), tmp_path / name)
    assert (tmp_path / name).stat().st_size
    with pytest.raises(OutputError, match="exists"):
        write_scene(Scene(), tmp_path / name)


@pytest.mark.parametrize("parts", [(), ("cameras",), "lines"])
def test_unknown_parts_are_refused(scene, tmp_path, parts):
    with pytest.raises(InputError, match="parts must be"):
        write_ply(scene, tmp_path / "none.ply", parts=parts)


def test_fans_cover_the_polygons():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    polygons = [square, 2 * square + 5, square[:3]]
    vertices, faces = triangle_fans(polygons)
    corners = vertices[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    np.testing.assert_allclose([area[:2].sum(), area[2:4].sum(), area[4:].sum()], [1, 4, 0.5])
    np.testing.assert_allclose([patch_area(polygon) for polygon in polygons], [1, 4, 0.5])
    assert triangle_fans([])[1].shape == (0, 3)
