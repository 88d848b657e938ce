"""``groma adjust`` of a pose graph: the file written, the numbers, and what is refused."""

import json

import numpy as np
import pytest

from groma.cli.main import run
from groma.geometry import se3
from groma.io.g2o import read_g2o, write_g2o
from groma.scene.pose_graph import GraphPoses, Motions, PoseGraph


@pytest.fixture
def graph(tmp_path):
    rng = np.random.default_rng(2)
    truth = se3.exp(rng.normal(size=(8, 6)))
    first = np.r_[np.arange(7), 0, 2]
    second = np.r_[np.arange(1, 8), 7, 6]
    motion = se3.compose(se3.inverse(truth[first]), truth[second])
    start = se3.compose(truth, se3.exp(0.05 * rng.normal(size=(8, 6))))
    made = PoseGraph(
        GraphPoses(np.arange(8), start), Motions(first, second, motion, np.tile(100 * np.eye(6), (9, 1, 1)))
    )
    path = tmp_path / "graph.g2o"
    write_g2o(made, path)
    return path


def test_the_graph_is_adjusted_and_written(graph, tmp_path, capsys):
    out = tmp_path / "out.g2o.gz"
    assert run(["adjust", str(graph), "-o", str(out), "--json", str(tmp_path / "report.json")]) == 0
    said = [line.split() for line in capsys.readouterr().out.splitlines()]
    rows = said[said.index(["number"]) + 1 :]  # where nothing is compiled yet, that comes first
    assert (rows[:2], rows[3][0]) == ([["poses", "8"], ["motions", "9"]], "Cost")
    assert rows[2][:-1] == "noise, times that of the file".split() and float(rows[2][-1]) < 1e-4
    numbers = json.loads((tmp_path / "report.json").read_text())
    assert numbers["num_poses"] == 8 and numbers["num_motions"] == 9 and numbers["converged"]
    assert numbers["chi_square"]["after"] < 1e-8 < numbers["chi_square"]["before"]
    poses = read_g2o(out).poses.world_from_body
    np.testing.assert_allclose(poses[0], read_g2o(graph).poses.world_from_body[0], atol=1e-15)
    assert np.abs(poses - read_g2o(graph).poses.world_from_body).max() > 1e-3


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["-o", "OUT.txt"], "written as .g2o"),
        (["--covariance", "OUT.npz"], "--covariance is for scenes with images"),
        (["--report", "OUT.html"], "--report is for scenes with images"),
        (["--protocol", "OUT.txt"], "--protocol is for scenes with images"),
        (["--no-lines"], "--no-lines is for scenes with images"),
        (["--diagnosis"], "--diagnosis is for scenes with images"),
        (["--line-residual", "bearing"], "--line-residual is for scenes with images"),
        (["--loss", "nothing"], "no loss named 'nothing'"),
    ],
)
def test_what_a_pose_graph_cannot_have_is_refused(graph, tmp_path, capsys, more, message):
    more = [word.replace("OUT", str(tmp_path / "out")) for word in more]
    assert run(["adjust", str(graph), *more]) == 1
    assert message in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["graph.g2o"]


def test_parts_are_said(graph, capsys):
    graph.write_text(graph.read_text() + "VERTEX_SE3:QUAT 50 0 0 0 0 0 0 1\n")
    assert run(["adjust", str(graph)]) == 0
    assert "falls into 2 parts" in "".join(capsys.readouterr())
