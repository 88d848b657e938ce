"""Pose graphs: the true poses come back, whatever the part, the plane and wrong motions."""

import numpy as np
import pytest

from groma.adjustment.graphs.linear_start import linear_start
from groma.adjustment.graphs.pose_graph import PoseGraphOptions, adjust_pose_graph
from groma.errors import InputError
from groma.geometry import quaternion, se3
from groma.scene.pose_graph import GraphPoses, Motions, PoseGraph
from groma.solver import levenberg_marquardt

pytestmark = pytest.mark.kernels


def ring(rng, count=12, noise=0.0, planar=False):
    """Poses on a circle that look ahead, with motions to the next two."""
    angle = 2 * np.pi * np.arange(count) / count
    turn = np.zeros((count, 3))
    turn[:, 2] = angle
    height = np.zeros(count) if planar else np.sin(3 * angle)
    truth = np.hstack([quaternion.exp(turn), np.column_stack([5 * np.cos(angle), 5 * np.sin(angle), height])])
    first = np.concatenate([np.arange(count), np.arange(count)])
    second = np.concatenate([np.arange(1, count + 1), np.arange(2, count + 2)]) % count
    error = rng.normal(size=(2 * count, 6)) * noise
    if planar:
        error[:, 2:5] = 0.0
    motion = se3.compose(se3.compose(se3.inverse(truth[first]), truth[second]), se3.exp(error))
    information = np.tile(np.eye(6) / max(noise, 1e-3) ** 2, (2 * count, 1, 1))
    return truth, PoseGraph(GraphPoses(np.arange(count), truth), Motions(first, second, motion, information), planar)


def disturbed(rng, graph, size):
    step = rng.normal(size=(len(graph.poses), 6)) * size
    step[0] = 0.0
    if graph.planar:
        step[:, 2:5] = 0.0
    moved = se3.compose(graph.poses.world_from_body, se3.exp(step))
    return graph.replace(poses=graph.poses.replace(world_from_body=moved))


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@pytest.mark.parametrize("planar", [False, True])
def test_true_poses_come_back(rng, planar):
    truth, graph = ring(rng, planar=planar)
    result = adjust_pose_graph(disturbed(rng, graph, 0.2))
    np.testing.assert_allclose(
        se3.log(se3.compose(se3.inverse(truth), result.graph.poses.world_from_body)), 0, atol=1e-6
    )
    assert result.report.converged and result.chi_square.sum() < 1e-6 < result.chi_square_before.sum()
    assert len(result.outliers) == 0


def test_the_start_is_the_cheaper_of_poses_and_motions(rng):
    """From zero, as from poses far off, the motions lead; near the minimum, or where poses are held, the poses do."""
    truth, graph = ring(rng, count=40, noise=0.01)
    zero = np.tile(se3.identity(), (40, 1))
    unknown = graph.replace(poses=graph.poses.replace(world_from_body=zero))
    result = adjust_pose_graph(unknown)
    assert result.from_motions and result.summary()["from_motions"]
    near = adjust_pose_graph(result.graph)
    assert not near.from_motions and near.report.initial_cost == pytest.approx(result.report.final_cost, rel=1e-6)
    found = se3.compose(truth[0], result.graph.poses.world_from_body)
    from_truth = adjust_pose_graph(graph).graph.poses.world_from_body
    np.testing.assert_allclose(se3.log(se3.compose(se3.inverse(from_truth), found)), 0.0, atol=1e-4)
    held = np.zeros(40, dtype=bool)
    held[20] = True
    kept = adjust_pose_graph(unknown.replace(poses=unknown.poses.replace(held=held)))
    assert kept.from_motions and kept.report.final_cost == pytest.approx(result.report.final_cost, rel=1e-6)
    np.testing.assert_array_equal(kept.graph.poses.world_from_body[20], zero[20])


def lattice(rng, side, noise):
    """Poses on a square lattice, turned at random, with motions to their neighbours whose angles and lengths err."""
    count, at = side * side, np.arange(side * side).reshape(side, side)
    places = np.stack([*np.divmod(np.arange(count), side), np.zeros(count)], axis=1)
    truth = se3.exp(np.hstack([np.zeros((count, 3)), rng.normal(size=(count, 3))]))
    truth[:, 4:] = places
    first = np.concatenate([at[:, :-1].ravel(), at[:-1].ravel()])
    second = np.concatenate([at[:, 1:].ravel(), at[1:].ravel()])
    motion = se3.compose(se3.inverse(truth[first]), truth[second])
    motion = se3.compose(motion, se3.exp(noise * rng.normal(size=(len(first), 6))))
    information = np.tile(np.eye(6) / noise**2, (len(first), 1, 1))
    return PoseGraph(GraphPoses(np.arange(count), truth), Motions(first, second, motion, information))


@pytest.mark.compiled
def test_noisy_turns_end_in_the_minimum_of_the_truth(rng):
    """Errors of 0.25 rad add up along a chain of motions to half a turn: only all motions together lead back."""
    graph = lattice(rng, 16, 0.25)
    best = adjust_pose_graph(graph).report.final_cost
    unknown = graph.replace(poses=graph.poses.replace(world_from_body=np.tile(se3.identity(), (256, 1))))
    found = adjust_pose_graph(unknown)
    assert found.from_motions and found.report.final_cost == pytest.approx(best, rel=1e-5)


@pytest.mark.parametrize("planar", [False, True])
def test_the_linear_start_is_exact_without_noise(rng, planar):
    truth, graph = ring(rng, planar=planar)
    held = np.arange(len(truth)) == 3
    start = linear_start(disturbed(rng, graph.replace(poses=graph.poses.replace(held=held)), 0.3), held)
    moved = se3.compose(se3.inverse(start.poses.world_from_body[:1]), start.poses.world_from_body)
    expected = se3.compose(se3.inverse(truth[:1]), truth)
    np.testing.assert_allclose(se3.log(se3.compose(se3.inverse(expected), moved)), 0.0, atol=1e-8)


def test_motions_without_information_give_no_linear_start(rng):
    _, graph = ring(rng, noise=0.01)
    information = graph.motions.information.copy()
    information[(graph.motions.first_idx == 5) | (graph.motions.second_idx == 5)] = 0.0
    loose = graph.replace(motions=graph.motions.replace(information=information))
    assert linear_start(loose, np.arange(12) == 0) is None
    assert np.isfinite(adjust_pose_graph(disturbed(rng, loose, 0.2)).graph.poses.world_from_body).all()


def test_poses_of_the_plane_stay_there(rng):
    _, graph = ring(rng, planar=True, noise=0.02)
    poses = adjust_pose_graph(disturbed(rng, graph, 0.2)).graph.poses.world_from_body
    np.testing.assert_array_equal(poses[:, 6], 0.0)
    np.testing.assert_array_equal(poses[:, :2], 0.0)


def test_the_cost_of_noise_is_its_redundancy(rng):
    """Twice the cost has the chi-square distribution of 6 (motions - poses + 1) degrees of freedom."""
    _, graph = ring(rng, count=40, noise=0.01)
    result = adjust_pose_graph(graph)
    redundancy = 6 * (80 - 39)
    assert abs(2 * result.report.final_cost - redundancy) < 4 * np.sqrt(2 * redundancy)
    assert result.noise == pytest.approx(np.sqrt(2 * result.report.final_cost / redundancy)) and not result.warnings


def test_a_graph_whose_motions_are_all_needed_has_no_noise(rng):
    _, graph = ring(rng, count=10)
    result = adjust_pose_graph(graph.replace(motions=graph.motions.take(np.flatnonzero(graph.odometry()))))
    assert np.isnan(result.noise) and result.summary()["noise"] is None and not result.warnings


def test_held_poses_and_the_first_of_each_part_stay(rng):
    truth, one = ring(rng, noise=0.01)
    count = len(truth)
    motions = one.motions
    both = PoseGraph(
        GraphPoses(np.arange(2 * count), np.concatenate([truth, truth]), np.arange(2 * count) == 5),
        Motions(*(np.concatenate([a, b]) for a, b in zip(
            (motions.first_idx, motions.second_idx, motions.first_from_second, motions.information),
            (motions.first_idx + count, motions.second_idx + count, motions.first_from_second, motions.information),
            strict=True,
        ))),
    )  # fmt: skip
    assert both.parts().tolist() == [0] * count + [1] * count
    poses = adjust_pose_graph(both).graph.poses.world_from_body
    moved = np.abs(poses - both.poses.world_from_body).max(axis=1) > 1e-9
    assert np.flatnonzero(~moved).tolist() == [5, count]


def test_a_start_from_the_motions_alone(rng):
    truth, graph = ring(rng, count=30)
    lost = graph.replace(poses=graph.poses.replace(world_from_body=np.tile(truth[:1], (30, 1))))
    np.testing.assert_allclose(lost.chained().poses.world_from_body, truth, atol=1e-12)


@pytest.mark.compiled
def test_damping_does_not_hold_back_a_long_chain(monkeypatch):
    # the ends of 3000 poses in a row move far for little: with the damping of free scenes, small steps remain
    rng, count = np.random.default_rng(5), 3000
    truth = np.zeros((count, 7))
    truth[:, 3], truth[:, 4] = 1.0, np.arange(count)
    first, second = np.hstack([[np.arange(count - 1), np.arange(1, count)], rng.integers(0, count, (3, 2)).T])
    sigma = np.array([0.01, 0.01, 0.0, 0.0, 0.0, 0.001])
    error = rng.normal(size=(len(first), 6)) * sigma
    motion = se3.compose(se3.compose(se3.inverse(truth[first]), truth[second]), se3.exp(error))
    information = np.tile(np.diag(np.where(sigma > 0, sigma, 1.0) ** -2.0), (len(first), 1, 1))
    graph = PoseGraph(GraphPoses(np.arange(count), truth), Motions(first, second, motion, information), planar=True)
    now = adjust_pose_graph(graph).report
    monkeypatch.setattr(levenberg_marquardt, "ROUNDING_DAMPING", levenberg_marquardt.MIN_DAMPING)
    before = adjust_pose_graph(graph).report
    assert now.converged
    assert now.iterations < before.iterations
    assert now.final_cost <= before.final_cost


@pytest.mark.compiled
def test_a_wrong_motion_loses(rng):
    _, graph = ring(rng, count=30, noise=0.01)
    motions = graph.motions
    wrong = PoseGraph(graph.poses, Motions(
        np.append(motions.first_idx, 3), np.append(motions.second_idx, 18),
        np.concatenate([motions.first_from_second, se3.exp(np.array([[3.0, 1, 0, 0, 0, 1]]))]),
        np.concatenate([motions.information, motions.information[:1]]),
    ))  # fmt: skip
    without = adjust_pose_graph(graph).graph.poses.world_from_body
    moved = {}
    for loss in ("none", "cauchy", "geman_mcclure"):
        result = adjust_pose_graph(wrong, PoseGraphOptions(loss=loss))
        moved[loss] = np.abs(result.graph.poses.world_from_body - without)[:, 4:].max()
        assert result.outliers.tolist() == ([] if loss == "none" else [60])
        # least squares spreads the error, and it is said; with a loss the others agree as they should
        assert ["contradict the others" in one for one in result.warnings] == [True] * (loss == "none")
        assert result.noise > 5.0 if loss == "none" else result.noise < 1.2
    # robust losses weigh right motions a little, too: the poses would differ by this even without the wrong one
    assert moved["none"] > 0.5 and max(moved["cauchy"], moved["geman_mcclure"]) < 0.05


@pytest.mark.compiled
def test_odometry_keeps_its_weight_unless_told(rng):
    _, graph = ring(rng, count=30, noise=0.01)
    assert graph.odometry().sum() == 29
    bad = graph.motions.first_from_second.copy()
    bad[4, 4] += 5.0
    graph = graph.replace(motions=graph.motions.replace(first_from_second=bad))
    doubted = adjust_pose_graph(graph, PoseGraphOptions(loss="geman_mcclure", trust_odometry=False)).outliers
    assert doubted.tolist() == [4]
    assert 4 not in adjust_pose_graph(graph, PoseGraphOptions(loss="geman_mcclure")).outliers


def test_a_graph_that_did_not_converge_says_so(rng):
    start = disturbed(rng, ring(rng, noise=0.02)[1], 0.3)
    short = adjust_pose_graph(start, PoseGraphOptions(max_iterations=1))
    assert not short.report.converged and short.warnings[0].startswith("Not converged after 1 step.")
    assert short.summary()["warnings"] == list(short.warnings)
    assert adjust_pose_graph(start, PoseGraphOptions(max_iterations=200)).warnings == ()


def test_a_graph_without_motions_is_refused():
    poses = GraphPoses(np.arange(2), np.tile([0.0, 0, 0, 1, 0, 0, 0], (2, 1)))
    with pytest.raises(InputError, match="no motions"):
        adjust_pose_graph(PoseGraph(poses, Motions()))
    with pytest.raises(InputError, match="Motion 0 has second_idx 2"):
        PoseGraph(poses, Motions([0], [2], [[0, 0, 0, 1, 0, 0, 0]], [np.eye(6)]))
