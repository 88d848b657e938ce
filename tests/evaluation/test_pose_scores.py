# SPDX-License-Identifier: BSD-3-Clause
"""Alignment and pose scores: exactness, noise, degenerate centres, known values on surveyed scenes."""

import numpy as np
import pytest

from groma.errors import InputError, ShapeError
from groma.evaluation import align_points, align_poses, evaluate_poses, score_poses
from groma.evaluation.poses import pairwise_auc, rotation_angle
from groma.geometry import quaternion
from groma.io import read_scene
from groma.scene import Similarity
from groma.scene.synthetic.scenes import holistic


def random_similarity(rng: np.random.Generator, scale: float = 3.0) -> Similarity:
    return Similarity(scale, quaternion.to_matrix(quaternion.exp(rng.normal(0, 2, (1, 3))))[0], rng.normal(0, 10, 3))


def random_poses(rng: np.random.Generator, centers: np.ndarray) -> np.ndarray:
    turns = quaternion.exp(rng.normal(0, 1, centers.shape))
    return np.hstack([turns, -quaternion.rotate(turns, centers)])


def assert_same(one: Similarity, two: Similarity, tolerance: float = 1e-10) -> None:
    assert one.scale == pytest.approx(two.scale, rel=tolerance)
    np.testing.assert_allclose(one.rotation, two.rotation, atol=tolerance)
    np.testing.assert_allclose(one.translation, two.translation, atol=10 * tolerance)


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("with_scale", [False, True])
def test_exact_points_give_the_exact_similarity(flat, with_scale):
    rng = np.random.default_rng(1)
    for _ in range(50):
        change = random_similarity(rng, 3.0 if with_scale else 1.0)
        points = rng.normal(0, 4, (5, 3)) * [1, 1, not flat]
        assert_same(align_points(points, change.points(points), with_scale), change)


def test_alignment_is_a_minimum():
    rng = np.random.default_rng(2)
    x, y = rng.normal(size=(2, 12, 3))
    best = align_points(x, y)

    def cost(change: Similarity) -> float:
        return float(((change.points(x) - y) ** 2).sum())

    for _ in range(50):
        turn = quaternion.to_matrix(quaternion.exp(rng.normal(0, 1e-3, (1, 3))))[0]
        scale = best.scale * np.exp(rng.normal(0, 1e-3))
        other = Similarity(scale, turn @ best.rotation, best.translation + rng.normal(0, 1e-3, 3))
        assert cost(other) > cost(best)
    assert np.linalg.det(best.rotation) == pytest.approx(1)


def test_points_that_do_not_fix_the_rotation_are_refused():
    line = np.outer(np.arange(5.0), [1, 2, 3]) + 100
    for points in (line, line[:2], np.ones((4, 3))):
        with pytest.raises(InputError, match="not on one line"):
            align_points(points, points)
    with pytest.raises(ShapeError):
        align_points(np.zeros((3, 3)), np.zeros((4, 3)))
    with pytest.raises(InputError, match="at least one"):
        align_poses(np.zeros((0, 7)), np.zeros((0, 7)))


@pytest.mark.parametrize("kind", ["general", "line", "two", "one", "same place"])
def test_poses_align_where_points_do_not(kind):
    rng = np.random.default_rng(3)
    centers = {
        "general": rng.normal(0, 3, (6, 3)),
        "line": np.outer(np.arange(6.0), [1, -2, 0.5]) + 4,
        "two": rng.normal(0, 3, (2, 3)),
        "one": rng.normal(0, 3, (1, 3)),
        "same place": np.tile(rng.normal(0, 3, 3), (4, 1)),
    }[kind]
    poses = random_poses(rng, centers)
    # Where the centres coincide no scale can be told: the alignment says one.
    change = random_similarity(rng, 1.0 if kind in ("one", "same place") else 0.2)
    assert_same(align_poses(poses, change.poses(poses)), change)
    scores = score_poses(poses, change.poses(poses))
    assert scores.center_max < 1e-10
    assert scores.rotation_deg_max < 1e-6


def test_rotation_angle_is_accurate_at_both_ends():
    axis = np.array([0.6, 0, 0.8])
    for angle in (0.0, 1e-12, 1e-7, 1.0, np.pi - 1e-9, np.pi):
        first = quaternion.exp((angle * axis)[None])
        assert rotation_angle(first, np.array([[0, 0, 0, 1.0]]))[0] == pytest.approx(angle, abs=1e-15)


def test_scores_of_known_errors():
    # Four corners of a square and its centre; the centre is off by 0.5 upwards, which the alignment spreads evenly.
    centers = np.array([[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0], [0, 0, 0.0]])
    rng = np.random.default_rng(4)
    true = random_poses(rng, centers)
    moved = true.copy()
    moved[4, 4:] = -quaternion.rotate(moved[4:, :4], np.array([[0, 0, 0.5]]))[0]
    scores = score_poses(moved, true, with_scale=False)
    # The best rigid motion is a shift by 0.1: distances 0.1 four times and 0.4.
    assert scores.center_rmse == pytest.approx(np.sqrt((4 * 0.1**2 + 0.4**2) / 5))
    assert scores.center_max == pytest.approx(0.4)
    assert scores.rotation_deg_mean == pytest.approx(0, abs=1e-6)


def test_auc_of_known_errors():
    rng = np.random.default_rng(5)
    true = random_poses(rng, rng.normal(0, 3, (2, 3)))
    assert pairwise_auc(true, true)[1.0] == pytest.approx(1)
    # The second camera turns about its own centre by two degrees: the pair's error is two degrees.
    turned = true.copy()
    turn = quaternion.exp(np.deg2rad([[0, 2.0, 0]]))
    turned[1:, :4] = quaternion.multiply(turn, true[1:, :4])
    turned[1:, 4:] = quaternion.rotate(turn, true[1:, 4:])
    auc = pairwise_auc(turned, true, thresholds_deg=(1.0, 4.0))
    assert auc == {1.0: 0.0, 4.0: pytest.approx(0.5)}
    # One image more in the reference: one good pair of three.
    assert pairwise_auc(true, true, num_missing=1)[1.0] == pytest.approx(1 / 3)


def test_images_are_matched_by_name():
    truth = holistic(10, seed=1).truth
    part = truth.subset([7, 2, 5, 0])
    scores = evaluate_poses(part, truth)
    assert (scores.num_images, scores.num_missing) == (4, 6)
    assert scores.center_rmse < 1e-12
    assert scores.auc[5.0] == pytest.approx(6 / 45)
    other = truth.replace(images=truth.images.replace(names=tuple(f"x{row}" for row in range(10))))
    with pytest.raises(InputError, match=r"'x0' and '00001.png'"):
        evaluate_poses(other, truth)
    inside = truth.replace(images=truth.images.replace(names=tuple(f"images/{name}" for name in truth.images.names)))
    scores = evaluate_poses(truth, inside)
    assert (scores.num_images, scores.center_rmse) == (10, pytest.approx(0, abs=1e-12))
    assert "10 names of images were found without folder" in scores.warnings[0]
    folders = truth.replace(images=truth.images.replace(names=tuple(f"{row}/1.png" for row in range(10))))
    alone = truth.subset([0]).replace(images=truth.subset([0]).images.replace(names=("1.png",)))
    with pytest.raises(InputError, match="More than one image of the reference"):
        evaluate_poses(alone, folders)
    twins = truth.replace(images=truth.images.replace(names=("a",) * 10))
    with pytest.raises(InputError, match="not unique"):
        evaluate_poses(twins, truth)


def test_scenes_that_hardly_share_images_or_share_names_alone_are_warned_of():
    scene = holistic(12, seed=3).start
    names = [f"{k}.png" for k in range(12)]
    renamed = scene.replace(images=scene.images.replace(names=tuple(names[:3] + [f"other {n}" for n in names[3:]])))
    scene = scene.replace(images=scene.images.replace(names=tuple(names)))
    scores = evaluate_poses(renamed, scene)
    assert scores.num_images == 3 and "Only 3 of 12 and 12 images" in scores.warnings[0]
    assert scores.to_dict()["warnings"] == list(scores.warnings)
    assert evaluate_poses(scene, scene).warnings == ()
    assert evaluate_poses(scene.subset([0, 1, 2, 3]), scene).warnings == ()
    other = holistic(12, seed=4).start
    other = other.replace(images=other.images.replace(names=tuple(names)))
    assert "unrelated" in evaluate_poses(other, scene).warnings[0]


def test_report_has_the_promised_keys():
    made = holistic(10, seed=1)
    report = evaluate_poses(made.start, made.truth).to_dict()
    assert {"center_rmse", "rotation_deg_mean", "rotation_deg_max", "auc", "num_images"} <= set(report)
    assert set(report["auc"]) == {"1", "3", "5", "10"}


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "rmse", "largest", "angle", "largest_angle"),
    [
        # Computed by another program; given to three digits.
        ("strecha_castle_p30", 0.110, 0.523, 0.205, 0.910),
        ("strecha_fountain_p11", 0.0029, None, None, None),
        ("strecha_herz_jesus_p8", 0.0038, None, None, None),
    ],
)
def test_surveyed_scenes(shared_data, name, rmse, largest, angle, largest_angle):
    folder = shared_data / name
    scores = evaluate_poses(read_scene(folder / "sparse_inc"), read_scene(folder / "sparse_gt"))
    assert scores.center_rmse == pytest.approx(rmse, rel=6e-3)
    if largest is not None:
        assert scores.center_max == pytest.approx(largest, abs=5e-4)
        assert scores.rotation_deg_mean == pytest.approx(angle, abs=5e-4)
        assert scores.rotation_deg_max == pytest.approx(largest_angle, abs=5e-4)


def test_poses_that_are_no_numbers_are_named():
    poses = random_poses(np.random.default_rng(0), np.random.default_rng(1).normal(size=(5, 3)))
    broken = poses.copy()
    broken[3, 5] = np.nan
    with pytest.raises(InputError, match="row 3 of source"):
        score_poses(broken, poses)
    with pytest.raises(InputError, match="row 3 of target"):
        align_poses(poses, broken)
