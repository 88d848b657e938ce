# SPDX-License-Identifier: BSD-3-Clause
"""Line scores: cases known by hand, exact distances against brute force, degenerate cases, readers of references."""

import json
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from groma.cli.main import run
from groma.errors import FileFormatError, GromaError, InputError, ShapeError
from groma.evaluation import Geometry, evaluate_lines, score_lines
from groma.evaluation.lines import Distances, segment_distance, triangle_distance
from groma.geometry import quaternion
from groma.io import write_colmap, write_obj, write_ply, write_scene
from groma.io.reference import holds_scene, read_line3dpp, read_reference
from groma.scene import Lines, Scene, Similarity
from groma.scene.synthetic.scenes import holistic

UNIT = np.array([[[0, 0, 0], [1.0, 0, 0]]])


def test_a_line_covers_itself():
    scores = score_lines(UNIT, UNIT, [0.01])
    assert scores.recall_length == scores.precision_count == scores.precision_strict == {0.01: 1.0}
    assert scores.precision_length == {0.01: 1.0}
    assert scores.inlier_length[0.01] == scores.covered_length[0.01] == scores.length == 1.0
    assert (scores.num_lines, scores.reference_length) == (1, 1.0)


def test_known_shares():
    """Reference: the unit segment. Estimate: its first half at height 0.05, and a line three long at height 0.2."""
    estimate = [[[0, 0.05, 0], [0.5, 0.05, 0]], [[-1, 0.2, 0], [2, 0.2, 0]]]
    scores = score_lines(estimate, UNIT, [0.01, 0.1, 0.25])
    # Within 0.1 the half covers sqrt(0.1^2 - 0.05^2) more than itself; within 0.25 the second line covers all.
    assert list(scores.recall_length.values()) == pytest.approx([0, 0.5 + np.sqrt(0.0075), 1], abs=5e-3)
    assert list(scores.covered_length.values()) == pytest.approx([0, 0.5 + np.sqrt(0.0075), 1], abs=5e-3)
    assert list(scores.precision_count.values()) == [0, 0.5, 1]
    assert list(scores.precision_strict.values()) == [0, 0.5, 0.5]
    # The second line lies within 0.25 of the unit segment on 1 + 2 sqrt(0.25^2 - 0.2^2) = 1.3 of its 3.
    assert list(scores.inlier_length.values()) == pytest.approx([0, 0.5, 0.5 + 1.3], abs=5e-3)
    assert list(scores.precision_length.values()) == pytest.approx([0, 0.5 / 3.5, 1.8 / 3.5], abs=2e-3)


def test_the_two_published_recalls_differ_for_repeated_lines():
    half = np.array([[[0, 0, 0], [0.5, 0, 0]]])
    scores = score_lines(np.repeat(half, 4, axis=0), UNIT, [1e-3])
    assert scores.inlier_length[1e-3] == pytest.approx(2.0)  # LIMAP's R_tau counts every line
    assert scores.recall_length[1e-3] == pytest.approx(0.5, abs=2e-3)


def test_recall_by_count_weighs_short_segments_as_long_ones():
    reference = np.array([[[0, 0, 0], [9.0, 0, 0]], [[0, 5, 0], [1.0, 5, 0]], [[0, 7, 0], [1.0, 7, 0]]])
    # The long one is covered by four ninths, the second by six tenths, the third not at all.
    estimate = [[[0, 0, 0], [4, 0, 0]], [[0, 5, 0], [0.6, 5, 0]]]
    scores = score_lines(estimate, reference, [1e-3])
    assert scores.recall_count[1e-3] == pytest.approx(1 / 3)
    assert scores.recall_length[1e-3] == pytest.approx(4.6 / 11, abs=2e-3)


def test_meshes_and_points_have_no_length_to_recall():
    square = Geometry(triangles=np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1.0, 0]]]))
    scores = score_lines([[[0.5, 0.5, -0.1], [0.5, 0.5, 0.1]]], square, [0.05])
    assert scores.precision_length[0.05] == pytest.approx(0.5, abs=0.02)
    assert np.isnan(scores.recall_length[0.05])
    assert np.isnan(scores.reference_length)
    cloud = Geometry(points=np.linspace([0, 0, 0], [1, 0, 0], 101))
    assert score_lines(UNIT, cloud, [0.006]).precision_strict == {0.006: 1.0}


def test_no_lines_and_lines_without_length():
    scores = score_lines(np.zeros((0, 2, 3)), UNIT, [0.1])
    assert scores.recall_length == {0.1: 0.0}
    assert np.isnan([scores.precision_count[0.1], scores.precision_length[0.1]]).all()
    scores = score_lines(np.zeros((1, 2, 3)), UNIT, [0.1])
    assert scores.precision_count == {0.1: 1.0}
    assert scores.length == 0
    json.dumps({key: str(value) for key, value in scores.to_dict().items()})


def test_refusals():
    with pytest.raises(InputError, match="no segments"):
        score_lines(UNIT, np.zeros((0, 2, 3)), [0.1])
    with pytest.raises(InputError, match="positive"):
        score_lines(UNIT, UNIT, [0.1, 0])
    with pytest.raises(InputError, match="positive"):
        score_lines(UNIT, UNIT, [])
    with pytest.raises(ShapeError, match="segments"):
        score_lines(np.zeros((3, 6)), UNIT, [0.1])
    with pytest.raises(InputError, match="finite"):
        score_lines(UNIT * np.nan, UNIT, [0.1])
    with pytest.raises(InputError, match="no extent"):
        score_lines(UNIT, np.zeros((1, 2, 3)))


def test_default_thresholds_are_thousandths_of_the_extent():
    scores = score_lines(UNIT, np.array([[[0, 0, 0], [0, 30, 40.0]]]))
    assert list(scores.recall_length) == [0.05, 0.25, 0.5]


@pytest.mark.parametrize("kind", ["segments", "triangles", "mixed"])
def test_distances_equal_those_to_every_element(kind):
    """Long and tiny elements together, near and far places: the search by anchors must not miss any."""
    rng = np.random.default_rng(7)
    size = rng.choice([0.01, 1.0, 20.0], (40, 1, 1))
    centre = rng.normal(0, 3, (40, 1, 3))
    segments = centre + size * rng.normal(size=(40, 2, 3)) * (kind != "triangles")
    triangles = centre + size * rng.normal(size=(40, 3, 3))
    places = np.concatenate([rng.normal(0, 5, (400, 3)), rng.normal(0, 100, (20, 3))])
    geometry = {
        "segments": Geometry(segments=segments),
        "triangles": Geometry(triangles=triangles),
        "mixed": Geometry(segments[:20], triangles[:20], places[:5] + 0.1),
    }[kind]
    parts = [np.full((len(places), 1), np.inf)]
    for table, distance in ((geometry.segments, segment_distance), (geometry.triangles, triangle_distance)):
        every = distance(np.repeat(places, len(table), axis=0), np.tile(table, (len(places), 1, 1)))
        parts.append(every.reshape(len(places), -1))
    parts.append(np.linalg.norm(places[:, None] - geometry.points, axis=2))
    expected = np.concatenate(parts, axis=1).min(1)
    np.testing.assert_allclose(Distances(geometry, 0.1).of(places), expected, rtol=1e-12, atol=1e-12)
    bounded = Distances(geometry, 0.1, 0.5, 2.0).of(places)
    for tau in (0.5, 1.0, 2.0):
        np.testing.assert_array_equal(bounded <= tau, expected <= tau)


def test_triangle_distance_by_minimisation():
    """The distance is the least over the triangle, found on a fine grid of it."""
    rng = np.random.default_rng(1)
    grid = np.array([[a, b] for a in np.linspace(0, 1, 81) for b in np.linspace(0, 1, 81) if a + b <= 1 + 1e-12])
    weights = np.column_stack([1 - grid.sum(1), grid])
    for _ in range(50):
        corners, place = rng.normal(size=(3, 3)), rng.normal(0, 2, 3)
        least = np.linalg.norm(weights @ corners - place, axis=1).min()
        exact = triangle_distance(place[None], corners[None])[0]
        assert least - 0.08 < exact <= least + 1e-12
    flat = np.array([[[0, 0, 0], [1, 0, 0], [2, 0, 0.0]]])
    assert triangle_distance(np.array([[3.0, 4, 0]]), flat)[0] == pytest.approx(np.sqrt(17))
    assert triangle_distance(np.array([[3.0, 4, 0]]), np.zeros((1, 3, 3)))[0] == 5


def test_scenes_align_by_their_images():
    scene = holistic(10, seed=1).truth
    rng = np.random.default_rng(0)
    change = Similarity(2.5, quaternion.to_matrix(quaternion.exp(rng.normal(0, 1, (1, 3))))[0], rng.normal(0, 3, 3))
    moved = scene.transformed(change)
    assert evaluate_lines(moved, scene, [1e-3]).precision_count[1e-3] < 0.5
    scores = evaluate_lines(moved, scene, [1e-3], align=True)
    assert scores.recall_length == scores.precision_strict == {1e-3: 1.0}
    assert scores.length == pytest.approx(scores.reference_length)


# References


def test_readers_of_line_sets(tmp_path):
    segments = np.random.default_rng(2).normal(size=(7, 2, 3))
    np.savez(tmp_path / "a.npz", lines=segments.reshape(-1, 6))
    np.savez(tmp_path / "b.npz", points=segments.reshape(-1, 3), edges=np.arange(14, dtype=np.int32).reshape(-1, 2))
    np.save(tmp_path / "c.npy", segments)
    (tmp_path / "d.txt").write_text("\n".join(" ".join(map(repr, row)) for row in segments.reshape(-1, 6).tolist()))
    scene = Scene(lines=Lines.through(segments))
    write_scene(scene, tmp_path / "e.npz")
    write_ply(scene, tmp_path / "f.ply")
    write_obj(scene, tmp_path / "g.obj")
    write_colmap(scene, tmp_path / "h")
    for name in ("a.npz", "b.npz", "c.npy", "d.txt", "e.npz", "f.ply", "g.obj", "h"):
        np.testing.assert_array_equal(read_reference(tmp_path / name).segments, segments, err_msg=name)
        assert holds_scene(tmp_path / name) == (name in ("e.npz", "h"))


CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]


def _ply(form: str, faces: list[list[int]]) -> bytes:
    head = f"ply\nformat {form} 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    if form == "ascii":
        rows = [" ".join(map(str, row)) for row in CUBE.tolist()] + [" ".join(map(str, [len(f), *f])) for f in faces]
        return (head + "\n".join(rows) + "\n").encode()
    order = "<" if "little" in form else ">"
    body = b"".join(struct.pack(f"{order}3f", *row) for row in CUBE)
    return head.encode() + body + b"".join(struct.pack(f"{order}B{len(f)}i", len(f), *f) for f in faces)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_meshes(tmp_path, form):
    (tmp_path / "quads.ply").write_bytes(_ply(form, QUADS))
    halves = [[f[0], f[k], f[k + 1]] for f in QUADS for k in (1, 2)]
    (tmp_path / "triangles.ply").write_bytes(_ply(form, halves))
    for name in ("quads", "triangles"):
        mesh = read_reference(tmp_path / f"{name}.ply").triangles
        normal = np.cross(mesh[:, 1] - mesh[:, 0], mesh[:, 2] - mesh[:, 0])
        assert len(mesh) == 12
        assert np.linalg.norm(normal, axis=1).sum() / 2 == pytest.approx(6)


def test_obj_meshes(tmp_path):
    rows = [f"v {x} {y} {z}" for x, y, z in CUBE] + ["f " + " ".join(f"{k + 1}/1/1" for k in QUADS[0]), "f -1 -2 -3"]
    (tmp_path / "mesh.obj").write_text("# cube\n" + "\n".join(rows))
    mesh = read_reference(tmp_path / "mesh.obj").triangles
    np.testing.assert_array_equal(mesh, CUBE[[[7, 6, 5], [0, 1, 3], [0, 3, 2]]])
    samples = Geometry(triangles=mesh).surface_points(1000)
    assert Distances(Geometry(triangles=mesh), 0.1).of(samples).max() < 1e-12


def test_line3dpp_rows(tmp_path):
    (tmp_path / "lines.txt").write_text(
        "# head\n0 0 0 1 2 3 2 a.jpg 1 2 3 4 b.jpg 5 6 7 8\n1 1 1 2 2 2 1 a.jpg 0 0 9 9\n"
    )
    lines = read_line3dpp(tmp_path / "lines.txt")
    assert lines.segments.tolist() == [[[0, 0, 0], [1, 2, 3]], [[1, 1, 1], [2, 2, 2]]]
    assert lines.image_names == ("a.jpg", "b.jpg")
    assert (lines.line_idx.tolist(), lines.image_idx.tolist()) == ([0, 0, 1], [0, 1, 0])
    assert lines.observations.tolist() == [[1, 2, 3, 4], [5, 6, 7, 8], [0, 0, 9, 9]]
    assert len(read_reference(tmp_path / "lines.txt").segments) == 2


@pytest.mark.shared
def test_references_of_the_shared_data(shared_data):
    edges = read_reference(shared_data / "pavilion_chair" / "gt_edges.npz").segments
    assert edges.shape == (33612, 2, 3)
    assert (np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1) > 0.3).sum() == 1516
    lines = read_line3dpp(shared_data / "south_building" / "line3dpp_reference.txt")
    assert (len(lines.segments), len(lines.observations), len(lines.image_names)) == (2490, 17606, 26)
    every = lines.segments[:800]
    scores = score_lines(every[::2], every, [0.003])
    assert scores.precision_strict == {0.003: 1.0}
    assert 0.45 < scores.recall_length[0.003] < 0.55


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.ply", b"not ply"),
        ("a.ply", _ply("binary_little_endian", QUADS)[:-3]),
        ("a.ply", _ply("ascii", [[0, 1, 99]])),
        ("a.ply", _ply("ascii", QUADS).replace(b"vertex 8", b"vertex 99999999999")),
        ("a.ply", _ply("binary_big_endian", QUADS).replace(b"face 6", b"face 6000000000000")),
        ("a.obj", b"v 1 2\n"),
        ("a.obj", b"v 1 2 3\nf 1 2 3\n"),
        ("a.obj", b"v 1 2 nan\n"),
        ("a.txt", b"0 0 0 1 2 3 2 a.jpg 1 2 3 4\n"),
        ("a.txt", b"0 0 0 1 2 x 0\n"),
        ("a.npz", b"PK\x03\x04"),
        ("a.npy", b"\x93NUMPY"),
        ("a.stl", b"solid"),
    ],
)
def test_damaged_references_are_refused(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FileFormatError, match=name):
        read_reference(tmp_path / name)


@pytest.mark.timeout(60)
def test_mutated_references_give_geometry_or_an_error(tmp_path):
    np.savez(tmp_path / "a.npz", points=CUBE, edges=np.array([[0, 1], [2, 3]]))
    sources = {"a.npz": (tmp_path / "a.npz").read_bytes(), "a.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"}
    sources |= {f"{form}.ply": _ply(form, QUADS) for form in ("ascii", "binary_little_endian")}

    @settings(max_examples=300)
    @given(
        st.sampled_from(sorted(sources)), st.floats(0, 1, exclude_max=True), st.binary(max_size=9), st.integers(0, 9)
    )
    def mutate(name, place, blob, skip):
        content = sources[name]
        at = int(place * len(content))
        (tmp_path / name).write_bytes(content[:at] + blob + content[at + skip :])
        try:
            assert isinstance(read_reference(tmp_path / name), Geometry)
        except GromaError as error:
            assert str(error)

    mutate()


def test_command(tmp_path, capsys):
    scene = Scene(lines=Lines.through(np.concatenate([UNIT, UNIT + np.array([0, 1, 0])])))
    write_colmap(scene, tmp_path / "map")
    np.save(tmp_path / "truth.npy", UNIT)
    arguments = ["evaluate", "lines", str(tmp_path / "map"), str(tmp_path / "truth.npy"), "--threshold", "0.01"]
    assert run([*arguments, "--json", "-"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["recall_length"], told["precision_count"], told["precision_length"]) == (
        {"0.01": 1.0},
        {"0.01": 0.5},
        {"0.01": 0.5},
    )
