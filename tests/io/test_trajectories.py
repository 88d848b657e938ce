# SPDX-License-Identifier: BSD-3-Clause
"""Trajectory files: round trips in the formats, how a format is recognised, directions, damage, gzip."""

import gzip

import numpy as np
import pytest

from groma.errors import FileFormatError, InputError, OutputError
from groma.geometry import quaternion, se3
from groma.io import Trajectory, read_scene, read_trajectory, write_trajectory


@pytest.fixture
def trajectory():
    rng = np.random.default_rng(4)
    turns = quaternion.normalize(rng.standard_normal((7, 4)))
    return Trajectory(1.4e9 + np.arange(7) * 0.05, np.hstack([turns, rng.standard_normal((7, 3))]))


@pytest.mark.parametrize("format", ["tum", "kitti", "euroc", "log"])
def test_round_trip(trajectory, tmp_path, format):
    path = tmp_path / "t.txt"
    write_trajectory(trajectory, path, format)
    for chosen in (format, "auto"):
        read = read_trajectory(path, chosen)
        np.testing.assert_allclose(
            se3.to_matrix(read.world_from_cam), se3.to_matrix(trajectory.world_from_cam), rtol=0, atol=1e-14
        )
        times = np.arange(7.0) if format in ("kitti", "log") else trajectory.timestamps
        np.testing.assert_allclose(read.timestamps, times, rtol=0, atol=1e-6)  # 64 bits of seconds since 1970
    packed = tmp_path / "t.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    np.testing.assert_array_equal(read_trajectory(packed).world_from_cam, read.world_from_cam)
    with pytest.raises(OutputError, match="exists already"):
        write_trajectory(trajectory, path, format)


def test_columns_and_directions(tmp_path):
    (tmp_path / "t").write_text("# time\n1.5 1 2 3 0 0 0.6 0.8\n")
    read = read_trajectory(tmp_path / "t")
    assert read.world_from_cam.tolist() == [[0, 0, 0.6, 0.8, 1, 2, 3]]
    np.testing.assert_allclose(
        se3.compose(read.cam_from_world, read.world_from_cam), [[0, 0, 0, 1, 0, 0, 0]], atol=1e-15
    )
    (tmp_path / "e").write_text("#timestamp, p_x\n1403636579763555584,1,2,3,0.8,0,0,0.6,0.1,0.2\n")
    read = read_trajectory(tmp_path / "e")
    assert read.world_from_cam.tolist() == [[0, 0, 0.6, 0.8, 1, 2, 3]]
    assert abs(read.timestamps[0] - 1403636579.763555584) < 1e-6
    (tmp_path / "k").write_text("0 -1 0 4 1 0 0 5 0 0 1 6\n" * 2)
    read = read_trajectory(tmp_path / "k", timestamps=[3.0, 4.0])
    wanted = [[0, -1, 0, 4], [1, 0, 0, 5], [0, 0, 1, 6]]
    np.testing.assert_allclose(se3.to_matrix(read.world_from_cam)[1, :3], wanted, rtol=0, atol=1e-15)
    assert read.timestamps.tolist() == [3.0, 4.0]
    with pytest.raises(FileFormatError, match="timestamps"):
        read_trajectory(tmp_path / "k", timestamps=[3.0])


def test_nanoseconds_separated_by_spaces_are_not_euroc(tmp_path):
    (tmp_path / "t").write_text("1403636579763555584 1 2 3 0 0 0 1\n")
    assert read_trajectory(tmp_path / "t").timestamps[0] == 1403636579763555584.0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no pose"),
        ("1.5 2 3\n", "got 3 words"),
        ("0 0 0 0 0 0 0 0\n", "unit length"),
        ("0 0 0 0 0 0 0 1\n1 2\n", "line 2"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", "not a rotation"),
        ("1 0 0 0 0 2 0 0 0 0 1 0\n", "not a rotation"),
        ("1 0 0 0 0 1 0 0 0 0 1 inf\n", "finite"),
        ("a b c d e f g h\n", "line 1: expected 8 finite numbers; got 'a'"),
    ],
)
def test_damage_is_refused(tmp_path, text, words):
    (tmp_path / "t").write_text(text)
    with pytest.raises(FileFormatError, match=words):
        read_trajectory(tmp_path / "t")


def test_unknown_formats_and_files(trajectory, tmp_path):
    with pytest.raises(InputError, match="Cannot read"):
        read_trajectory(tmp_path / "missing")
    with pytest.raises(InputError, match="format"):
        read_trajectory(tmp_path, "bag")
    with pytest.raises(InputError, match="format"):
        write_trajectory(trajectory, tmp_path / "t", "bag")
    (tmp_path / "t").write_bytes(b"\x1f\x8bnot gzip")
    with pytest.raises(FileFormatError):
        read_trajectory(tmp_path / "t")


LOG = "0 0 0\n0 -1 0 4\n1 0 0 5\n0 0 1 6\n0 0 0 1\n"


def test_matrices_of_redwood(tmp_path):
    (tmp_path / "t.log").write_text(LOG + LOG.replace("0 0 0\n", "1 1 2\n", 1))
    read = read_trajectory(tmp_path / "t.log")
    np.testing.assert_allclose(read.world_from_cam, [[0, 0, np.sqrt(0.5), np.sqrt(0.5), 4, 5, 6]] * 2, atol=1e-15)
    assert read.timestamps.tolist() == [0, 1]
    # Three whole numbers begin BAL files, too.
    with pytest.raises(FileFormatError, match=r"is a trajectory, not a scene.*groma evaluate trajectory"):
        read_scene(tmp_path / "t.log")
    (tmp_path / "cut.log").write_text(LOG[:-9])
    with pytest.raises(FileFormatError, match="is not a scene: expected"):
        read_scene(tmp_path / "cut.log")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (LOG[:-9], "expected 5 lines for each pose; got 4"),
        (LOG.replace("0 0 0\n", "0 0.5 0\n", 1), "line 1: expected three whole numbers"),
        (LOG.replace("0 0 0 1", "0 0 1 1"), "line 5: the last row"),
        (LOG.replace("1 0 0 5", "2 0 0 5"), "line 2: the first three columns are not a rotation"),
    ],
)
def test_damaged_matrices_are_refused(tmp_path, text, message):
    (tmp_path / "t.log").write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_trajectory(tmp_path / "t.log", "log")
