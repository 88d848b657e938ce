"""Well-known pose graphs: both solvers reach the minimum, from the start in the file and from the motions alone."""

import pytest

from groma.adjustment.graphs.pose_graph import PoseGraphOptions, adjust_pose_graph
from groma.io.g2o import read_g2o


@pytest.mark.parametrize(
    ("name", "chi_square", "solver"),
    [
        ("input_M3500_g2o.g2o.gz", 137.915, "sparse"),
        ("input_M3500_g2o.g2o.gz", 137.915, "pcg"),
        ("parking-garage.g2o.gz", 1.23869, "sparse"),
        pytest.param("parking-garage.g2o.gz", 1.23869, "pcg", marks=pytest.mark.slow),
    ],
)
def test_known_graphs_reach_their_minimum(shared_data, name, chi_square, solver):
    """Both solvers and both starts reach one minimum; GTSAM finds the same (``benchmarks/pose_graphs.py``)."""
    graph = read_g2o(shared_data / "posegraph" / name)
    for start in (graph, graph.chained()):
        report = adjust_pose_graph(start, PoseGraphOptions(linear_solver=solver)).report
        assert report.converged and 2 * report.final_cost == pytest.approx(chi_square, rel=1e-5)
