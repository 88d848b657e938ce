"""Pose graphs in files of g2o: what is read, what is written again, what is refused."""

import gzip

import numpy as np
import pytest

from groma.errors import FileFormatError, InputError, OutputError
from groma.geometry import quaternion, se3
from groma.io import read_scene
from groma.io.g2o import is_g2o, looks_like_g2o, read_g2o, write_g2o

SPACE = """# two poses
PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 3 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 7 1 2 3 0 0 2 0
FIX 3
EDGE_SE3:QUAT 3 7 1 2 3 0 0 1 0 9 0 0 0 0 1 9 0 0 0 0 9 0 0 0 36 0 0 36 0 36
"""
PLANE = """VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1 2 0.5
EDGE_SE2 0 1 1 2 0.5 4 1 0 4 0 16
"""


def file_with(tmp_path, text, name="graph.g2o"):
    path = tmp_path / name
    path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
    return path


def test_poses_and_motions_of_space(tmp_path):
    graph = read_g2o(file_with(tmp_path, SPACE))
    assert graph.poses.ids.tolist() == [3, 7] and graph.poses.held.tolist() == [True, False] and not graph.planar
    np.testing.assert_array_equal(graph.poses.world_from_body[1], [0, 0, 1, 0, 1, 2, 3])  # scaled to length one
    assert (graph.motions.first_idx.tolist(), graph.motions.second_idx.tolist()) == ([0], [1])
    # g2o's rotation error is half the angle: a quarter of the information per square radian, half of that across
    expected = np.diag([9, 9, 9, 9, 9, 9.0])
    expected[0, 5] = expected[5, 0] = 0.5
    np.testing.assert_array_equal(graph.motions.information[0], expected)


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def test_information_is_that_of_g2o_error(rng, tmp_path):
    """The squared error equals that of g2o, (translation, vector part of the quaternion), for a small error."""
    motion = se3.exp(rng.normal(size=6) * 0.3)
    root = rng.normal(size=(6, 6))
    full = root.T @ root
    numbers = [*motion[4:], *motion[:4], *full[np.triu_indices(6)]]
    text = "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 0 0 0 0 0 0 1\nEDGE_SE3:QUAT 0 1 "
    graph = read_g2o(file_with(tmp_path, text + " ".join(map(repr, map(float, numbers)))))
    error = rng.normal(size=6) * 1e-5
    wrong = se3.exp(error)
    of_file = np.concatenate([wrong[4:], wrong[:3]])
    np.testing.assert_allclose(error @ graph.motions.information[0] @ error, of_file @ full @ of_file, rtol=1e-4)


def test_poses_and_motions_of_the_plane(tmp_path):
    graph = read_g2o(file_with(tmp_path, PLANE, "graph.g2o.gz"))
    assert graph.planar
    np.testing.assert_allclose(graph.poses.world_from_body[1], [*quaternion.exp(np.array([0, 0, 0.5])), 1, 2, 0])
    rows = np.array([0, 1, 5])
    np.testing.assert_array_equal(graph.motions.information[0][np.ix_(rows, rows)], [[4, 1, 0], [1, 4, 0], [0, 0, 16]])
    assert np.count_nonzero(graph.motions.information) == 5


@pytest.mark.parametrize("text", [SPACE, PLANE])
@pytest.mark.parametrize("name", ["again.g2o", "again.g2o.gz"])
def test_what_is_written_is_read_again(tmp_path, text, name):
    graph = read_g2o(file_with(tmp_path, text))
    write_g2o(graph, tmp_path / name)
    again = read_g2o(tmp_path / name)
    for table in ("poses", "motions"):
        for column, values in vars(getattr(graph, table)).items():
            np.testing.assert_allclose(getattr(getattr(again, table), column), values, atol=1e-15)
    assert again.planar == graph.planar
    with pytest.raises(OutputError):
        write_g2o(graph, tmp_path / name)


def test_poses_that_are_not_given_are_composed(tmp_path):
    edges = (
        "\n".join(line for line in PLANE.splitlines() if line.startswith("EDGE")) + "\nEDGE_SE2 2 1 1 0 0 1 0 0 1 0 1"
    )
    graph = read_g2o(file_with(tmp_path, edges))
    assert graph.poses.ids.tolist() == [0, 1, 2]
    np.testing.assert_allclose(graph.poses.world_from_body[1, 4:], [1, 2, 0])
    np.testing.assert_allclose(graph.poses.world_from_body[2, 4:], [1 - np.cos(0.5), 2 - np.sin(0.5), 0], atol=1e-15)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no poses"),
        ("VERTEX_XZ 1 2 3\n", "line 1: 'VERTEX_XZ' is not read"),
        ("VERTEX_XY 1 2 3\n", "line 1: VERTEX_XY is of a graph with landmarks.* remove all lines of landmarks"),
        (SPACE + "EDGE_SE3_TRACKXYZ 0 1 0 0 0 1 1 0 0 1 0 1\n", "EDGE_SE3_TRACKXYZ is of a graph with landmarks"),
        (PLANE + "EQUIV 0 9\n", "EQUIV names pose 9"),
        (PLANE + "EQUIV 0\n", "takes 2 numbers; got 1"),
        ("VERTEX_SE2 1 2 3\n", "takes 4 numbers; got 3"),
        ("VERTEX_SE2 1 2 3 x\n", r"line 1: expected 4 finite numbers after VERTEX_SE2; got 'x'"),
        ("VERTEX_SE2 1 2 3 nan\n", r"line 1: expected 4 finite numbers .*; got 'nan'"),
        ("VERTEX_SE2 1.5 2 3 4\n", "1.5 is not the id"),
        ("VERTEX_SE2 1 2 3 4\nVERTEX_SE2 1 2 3 4\n", "same id"),
        ("VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 5 1 2 0.5 4 1 0 4 0 16\n", "names pose 5"),
        (PLANE + "FIX 9\n", "FIX names pose 9"),
        (PLANE + "EDGE_SE2 0 1 1 2 0.5 -4 0 0 4 0 16\n", "1 of 2 motions is not .*, the first from 0 to 1;"),
        (PLANE + SPACE, "mixes"),
        ("VERTEX_SE3:QUAT 7 1 2 3 0 0 0 0\n", "quaternion of length 0"),
    ],
)
def test_damaged_files_are_refused(tmp_path, text, message):
    with pytest.raises(FileFormatError, match=message):
        read_g2o(file_with(tmp_path, text))


def test_a_cut_archive_and_a_missing_file_are_refused(tmp_path):
    path = file_with(tmp_path, SPACE, "graph.g2o.gz")
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(FileFormatError):
        read_g2o(path)
    with pytest.raises(InputError):
        read_g2o(tmp_path / "none.g2o")


def test_first_bytes_tell_a_pose_graph():
    assert looks_like_g2o(SPACE.split("\n", 1)[1].encode()) and looks_like_g2o(PLANE.encode())
    assert not looks_like_g2o(b"16 22106 83718\n")


def test_planar_graphs_of_toro_hold_the_same(tmp_path):
    toro = "VERTEX2 0 0 0 0\nVERTEX2 1 1 2 0.5\nEDGE2 0 1 1 2 0.5 4 1 5 16 2 3\n"  # xx xy yy aa xa ya
    read = read_g2o(file_with(tmp_path, toro, "graph.graph"))
    same = read_g2o(file_with(tmp_path, PLANE.replace("4 1 0 4 0 16", "4 1 2 5 3 16")))
    assert read.planar
    np.testing.assert_array_equal(read.poses.world_from_body, same.poses.world_from_body)
    np.testing.assert_array_equal(read.motions.information, same.motions.information)


def test_poses_of_two_names_are_one(tmp_path):
    """Chains of EQUIV too: 4 is 2 is 0; a motion from a pose to itself says nothing."""
    motion = "1 2 0.5 4 1 5 16 2 3\n"
    vertices = "".join(f"VERTEX2 {name} {name} 0 0\n" for name in range(5))
    edges = f"EDGE2 0 1 {motion}EDGE2 1 2 {motion}EDGE2 2 3 {motion}EDGE2 3 4 {motion}EDGE2 2 4 {motion}"
    read = read_g2o(file_with(tmp_path, f"{vertices}{edges}EQUIV 4 2\nEQUIV 2 0\nFIX 2\n", "a.graph"))
    edges = f"EDGE2 0 1 {motion}EDGE2 1 0 {motion}EDGE2 0 3 {motion}EDGE2 3 0 {motion}"
    kept = "".join(f"VERTEX2 {name} {name} 0 0\n" for name in (0, 1, 3))
    same = read_g2o(file_with(tmp_path, f"{kept}{edges}FIX 0\n", "b.graph"))
    for name, value in [*vars(read.poses).items(), *vars(read.motions).items()]:
        expected = getattr(same.poses, name, getattr(same.motions, name, None))
        np.testing.assert_array_equal(value, expected)
    edges = f"EDGE2 0 1 {motion}EDGE2 1 2 {motion}EQUIV 2 0\n"
    assert read_g2o(file_with(tmp_path, edges, "c.graph")).poses.ids.tolist() == [0, 1]  # without poses


def test_graphs_of_toro_in_space_hold_the_same(rng, tmp_path):
    """Roll, pitch, yaw are angles about x, y, z, the last outermost; the information is of whole angles."""
    place, (roll, pitch, yaw) = rng.normal(size=3), rng.normal(size=3)
    about = [np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]]) for a in (roll, pitch, yaw)]
    turn = np.roll(about[2], (2, 2), (0, 1)) @ np.roll(about[1], (1, 1), (0, 1)) @ about[0]
    root = rng.normal(size=(6, 6))
    full = root.T @ root
    six = " ".join(map(repr, map(float, [*place, roll, pitch, yaw])))
    upper = " ".join(map(repr, map(float, full[np.triu_indices(6)])))
    graph = read_g2o(
        file_with(tmp_path, f"VERTEX3 0 0 0 0 0 0 0\nVERTEX3 1 {six}\nEDGE3 0 1 {six} {upper}\nEDGE3 0 1 {six}\n")
    )
    expected = np.vstack([np.c_[turn, place], [0, 0, 0, 1]])
    for pose in (graph.poses.world_from_body[1], *graph.motions.first_from_second):
        np.testing.assert_allclose(se3.to_matrix(pose), expected, atol=1e-14)
    np.testing.assert_allclose(graph.motions.information, [full, np.eye(6)], rtol=1e-14)


@pytest.mark.parametrize("text", [SPACE, PLANE, "EDGE3 0 1 0 0 0 0 0 0\n"])
@pytest.mark.parametrize("name", ["graph.txt", "graph.gz", "graph.g2o"])
def test_content_tells_a_pose_graph(tmp_path, text, name):
    assert is_g2o(file_with(tmp_path, text, name))


def test_other_files_are_no_pose_graphs(tmp_path):
    assert not is_g2o(file_with(tmp_path, "16 22106 83718\n", "bal.txt"))
    assert not is_g2o(tmp_path) and not is_g2o(tmp_path / "none.txt")
    (tmp_path / "cut.gz").write_bytes(b"\x1f\x8b\x08")
    assert not is_g2o(tmp_path / "cut.gz")
    with pytest.raises(FileFormatError, match=r"is a pose graph, not a scene\. Optimise it with groma adjust"):
        read_scene(file_with(tmp_path, PLANE, "graph.txt"))
