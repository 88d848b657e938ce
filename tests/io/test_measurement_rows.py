# SPDX-License-Identifier: BSD-3-Clause
"""Files of distances, known planes, directions and poses: one a line, and what is refused in one sentence."""

import numpy as np
import pytest

from groma.errors import FileFormatError, InputError
from groma.io.measured_poses import holds_covariances, read_camera_poses
from groma.io.pose_files import read_poses
from groma.io.survey import read_directions, read_distances, read_known_planes, read_measured_poses  # fmt: skip


def written(tmp_path, text):
    path = tmp_path / "file.txt"
    path.write_text(text)
    return path


def test_known_planes(tmp_path):
    text = "name nx ny nz w sigma\np1 z 12.5 0.01\np2, 0, 0, 2, -25\nplane:3;1;0;0;4;0.1\n# a comment\nIMG x -3\n"
    found = read_known_planes(written(tmp_path, text))
    assert found.names == ("p1", "p2", "plane:3", "IMG")
    np.testing.assert_allclose(found.hesse, [[0, 0, 1, -12.5], [0, 0, 1, -12.5], [1, 0, 0, 4], [1, 0, 0, 3]])
    np.testing.assert_array_equal(found.sigma, [0.01, np.nan, 0.1, np.nan])


def test_directions(tmp_path):
    found = read_directions(written(tmp_path, "a.jpg 0 9.81 0 0.5\nline:5 vertical\nb.jpg 0 0 2 0.1 0 3 0\n"))
    assert found.names == ("a.jpg", "line:5", "b.jpg")
    np.testing.assert_allclose(found.vectors, [[0, 1, 0], [0, 0, -1], [0, 0, 1]])
    np.testing.assert_allclose(found.in_world, [[0, 0, -1], [0, 0, -1], [0, 1, 0]])
    np.testing.assert_array_equal(found.sigma_deg, [0.5, np.nan, 0.1])


def test_poses_with_covariances(tmp_path):
    matrix = np.diag([1.0, 2, 3, 4, 5, 6]) + 0.1
    upper = " ".join(f"{matrix[i, j]}" for i in range(6) for j in range(i, 6))
    whole = " ".join(map(str, matrix.ravel()))
    pose = "1 2 3 0 0 0.6 0.8"
    path = written(tmp_path, f"a {pose}\nb {pose} 0.1 2\nc {pose} {upper}\nd {pose} {whole}\n")
    found = read_measured_poses(path)
    np.testing.assert_allclose(found.world_from_cam, np.tile([1, 2, 3, 0, 0, 0.6, 0.8], (4, 1)))
    assert np.isnan(found.covariance[0]).all()
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance[1])), [0.1] * 3 + [np.radians(2)] * 3)
    np.testing.assert_allclose(found.covariance[2], matrix)
    np.testing.assert_allclose(found.covariance[3], matrix)
    assert holds_covariances(path) and read_camera_poses(path, ["a"]).names == ("a", "b", "c", "d")
    # the same file places photographs
    poses = read_poses(path, ["x/a.jpg", "y/b.jpg", "other.jpg"])
    assert poses.names == ("x/a.jpg", "y/b.jpg") and "without folder or ending" in poses.sentences[0]
    np.testing.assert_allclose(poses.cam_from_world[0, :4], [0, 0, -0.6, 0.8])


def test_any_file_of_poses_will_do(tmp_path):
    """Trajectories do not say how exact they are."""
    path = written(tmp_path, "0.0 1 2 3 0 0 0 1\n1.0 4 5 6 0 0 0.6 0.8\n")
    assert not holds_covariances(path) and not holds_covariances(tmp_path / "missing.txt")
    found = read_camera_poses(path, ["0.0.jpg", "1.0.jpg"])
    np.testing.assert_allclose(found.world_from_cam[:, :3], [[1, 2, 3], [4, 5, 6]])
    assert np.isnan(found.covariance).all()


@pytest.mark.parametrize(
    ("read", "text", "words"),
    [
        (read_known_planes, "p1 0 0 0 3", "normal of a plane is not zero"),
        (read_known_planes, "p1 z 3 -1", "must be positive"),
        (read_known_planes, "p1 0 1 2", "expected name nx ny nz w"),
        (read_known_planes, "p1 z 1e300", "no measurement"),
        (read_known_planes, "", "nothing in it"),
        (read_directions, "a 0 0 0", "direction is not zero"),
        (read_directions, "a up 1", "expected name x y z sigma"),
        (read_directions, "a 0 1 nan", "expected a direction"),
        (read_distances, "a b -1", "must be positive"),
        (read_distances, "a b", "expected name name distance"),
        (read_measured_poses, "a 1 2 3 1 1 1 1", "unit quaternion"),
        (read_measured_poses, "a 1 2 3 0 0 0 1\na 1 2 3 0 0 0 1", "has a pose already"),
        (read_measured_poses, "a 1 2 3 0 0 0 1 " + "1 " * 36, "not positive definite"),
        (read_measured_poses, "a 1 2 3 0 0 0 1 " + "1 0 " * 18, "not symmetric"),
        (read_measured_poses, "a 1 2 3 0 0 0 1 0 1", "must be positive"),
    ],
)
def test_what_is_wrong_is_told(tmp_path, read, text, words):
    with pytest.raises((FileFormatError, InputError), match=words):
        read(written(tmp_path, text))
