"""Adjusting real data: published minima of bundle adjustment problems, and surveyed camera positions."""

import pytest

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.evaluation.poses import evaluate_poses
from groma.io import read_scene

pytestmark = pytest.mark.shared

#: Lowest known half sum of squares, rounded up in the fifth digit.
MINIMA = {
    "problem-49-7776-pre.txt.bz2": 1.3345e4,
    "problem-21-11315-pre.txt.bz2": 3.0379e4,
    "problem-16-22106-pre.txt.bz2": 1.80340e4,
}


@pytest.mark.parametrize("linear_solver", ["dense", "sparse", "pcg"])
@pytest.mark.parametrize("name", MINIMA)
def test_reaches_the_known_minimum(shared_data, name, linear_solver):
    scene = read_scene(shared_data / "bal" / name)
    report = adjust(scene, AdjustOptions(loss="none", refine_intrinsics=True, linear_solver=linear_solver)).report
    assert report.solve.final_cost <= MINIMA[name]


@pytest.mark.parametrize(
    ("name", "center_rmse"),
    [("strecha_castle_p30", 0.0275), ("strecha_fountain_p11", 0.0029), ("strecha_herz_jesus_p8", 0.0038)],
)
def test_defaults_reach_the_survey(shared_data, name, center_rmse):
    """Plain least squares leaves the castle at 0.110 m: one image has wrong matches. The defaults must cope."""
    start, reference = read_scene(shared_data / name / "sparse_inc"), read_scene(shared_data / name / "sparse_gt")
    scores = evaluate_poses(adjust(start).scene, reference)
    assert scores.center_rmse <= center_rmse
