# SPDX-License-Identifier: BSD-3-Clause
"""Poses from matches: exact where matches are, as uncertain as stated, refused where there is nothing in it."""

from pathlib import Path

import numpy as np
import pytest
from worlds import CAMERA, make_world, pose_of, project

import groma
from groma.errors import InputError, ShapeError
from groma.geometry import quaternion, se3, so3
from groma.localization.pose.absolute_pose import PoseOptions, estimate_absolute_pose, pose_from_matches
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.hypotheses import max_errors
from groma.localization.pose.matches import Matches
from groma.localization.pose.refinement import _of_normal_noise, _pull, fitted, last_scale, refine
from groma.localization.pose.verdict import most_votes

#: What wrong matches may still do: the loss leaves them a small weight. A pixel is 0.007 here.
OUTLIERS = 5e-4


@pytest.mark.parametrize("kinds", [("points",), ("lines",), ("points", "lines")])
def test_exact_matches_give_the_exact_pose(kinds):
    rng = np.random.default_rng(3)
    for _ in range(5):
        world = make_world(rng)
        found = pose_of(world, kinds)
        assert found.status == "localized", found.sentence
        shift, turn = world.errors(found.cam_from_world)
        assert shift < 1e-6
        assert turn < 1e-6
        assert found.point_inliers.all() and found.line_inliers.all()


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV_FISHEYE"])
def test_lenses_with_distortion(model):
    numbers = {"SIMPLE_RADIAL": [600.0, 320.0, 240.0, -0.08], "OPENCV_FISHEYE": [500, 500, 320, 240, 0.02, 0.01, 0, 0]}
    camera = QueryCamera(model, np.array(numbers[model], float), 640, 480)
    world = make_world(np.random.default_rng(5), camera=camera)
    found = pose_of(world, ("points", "lines"), camera)
    assert found.status == "localized"
    assert max(world.errors(found.cam_from_world)) < 1e-6


def test_wrong_matches_do_not_pull_the_pose_away():
    """Matches of a rendered room, two thirds of which are wrong, and more noise stated than there is."""
    made = np.load(Path(__file__).parents[1] / "data" / "localization" / "rendered_room.npz")
    camera = QueryCamera("PINHOLE", made["camera"], *map(int, made["size"]))
    options = PoseOptions(max_error=4.0, look_for_rival=False)
    found = estimate_absolute_pose(camera, made["points2d"], made["points3d"], sigma=(2.0, 2.0), options=options)
    assert found.status == "localized" and found.cam_from_world is not None, found.sentence
    off = se3.log(se3.compose(found.cam_from_world[None], se3.inverse(made["cam_from_world"][None])))[0]
    assert np.abs(off).max() < 0.1
    away = np.linalg.norm(camera.project(found.cam_from_world, made["points3d"]) - made["points2d"], axis=1)
    assert (away < 4.0).sum() >= 44


def test_far_wrong_matches_have_no_pull():
    """Two thirds are off to one side, by 30 to 200 pixels: the pose is that of the others, to the last digits."""
    rng = np.random.default_rng(53)
    for _ in range(3):
        world = make_world(rng, points=150, lines=60)
        world.points2d[:] += rng.normal(0.0, 1.0, world.points2d.shape)
        world.segments2d[:] += rng.normal(0.0, 1.0, world.segments2d.shape)
        wrong, wrong_lines = np.arange(150) >= 50, np.arange(60) >= 20
        world.points2d[wrong, 0] += rng.uniform(30.0, 200.0, 100)
        way = world.segments2d[:, 1] - world.segments2d[:, 0]
        across = np.column_stack([-way[:, 1], way[:, 0]]) / np.linalg.norm(way, axis=1, keepdims=True)
        world.segments2d[wrong_lines] += rng.uniform(30.0, 200.0, (40, 1, 1)) * across[wrong_lines, None]
        every = Matches(world.points2d, world.points3d, world.segments2d, world.segments3d)
        start = se3.compose(se3.exp(np.array([[0.01, -0.01, 0.01, 0.002, 0.002, -0.002]])), world.pose[None])[0]
        among = refine(CAMERA, every, start, max_errors(every))
        squares = np.concatenate([among.points.square[wrong], among.lines.square[wrong_lines]])
        assert squares.min() > max_errors(every)[0] ** 2  # none of them is near by chance
        alone = refine(CAMERA, every.take(~wrong, ~wrong_lines), start, max_errors(every))
        assert among.pose == pytest.approx(alone.pose, abs=1e-9)
        assert max(world.errors(among.pose)) < 0.02


def test_matches_that_a_start_misses_are_gathered():
    """A start that agrees with a few of the matches alone, as of a sample of noisy ones, ends at all of them."""
    rng = np.random.default_rng(59)
    world = make_world(rng, points=100, lines=0)
    matches = Matches(world.points2d + rng.normal(0.0, 1.0, world.points2d.shape), world.points3d)
    start = se3.compose(se3.exp(np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.04]])), world.pose[None])[0]
    errors = max_errors(matches)
    near = fitted(CAMERA, matches, start, errors).points.square <= errors[0] ** 2
    assert 20 < near.sum() < 80
    found = refine(CAMERA, matches, start, errors)
    assert (found.points.square <= errors[0] ** 2).all()
    assert max(world.errors(found.pose)) < 0.02


def test_matches_gathered_around_a_start_all_have_a_pull():
    """Exact lines that a start is off from by more than their noise, among a few that are wrong by as much."""
    rng = np.random.default_rng(61)
    world = make_world(rng, points=0, lines=60)
    world.segments2d[:10] += rng.normal(0.0, 4.0, (10, 2, 2))
    lines = Matches(segments2d=world.segments2d, segments3d=world.segments3d).with_sigma(0.2)
    start = se3.compose(se3.exp(np.array([[0.0, 0.0, 0.0, 0.005, -0.008, 0.0]])), world.pose[None])[0]
    errors = max_errors(lines)
    assert (fitted(CAMERA, lines, start, errors).lines.square > (errors[1] / 0.2) ** 2).mean() > 0.5
    found = refine(CAMERA, lines, start, errors, gathered=True)
    assert max(world.errors(found.pose)) < 1e-5
    assert found.line_inliers[10:].all()


def test_most_matches_may_be_wrong():
    rng = np.random.default_rng(7)
    for seed in range(5):
        world = make_world(rng, points=100, lines=40)
        points, lines = rng.permutation(100)[:60], rng.permutation(40)[:24]
        world.points3d[points] = rng.permutation(world.points3d[points])
        world.segments3d[lines] = rng.permutation(world.segments3d[lines])
        found = pose_of(world, ("points", "lines"), options=PoseOptions(seed=seed))
        assert found.status == "localized"
        assert max(world.errors(found.cam_from_world)) < OUTLIERS
        assert found.point_inliers.sum() == pytest.approx(40, abs=3)


def test_several_lines_may_claim_a_segment():
    rng = np.random.default_rng(11)
    world = make_world(rng, points=20, lines=30)
    others = world.segments3d[rng.permutation(30)]
    found = estimate_absolute_pose(
        CAMERA,
        world.points2d,
        world.points3d,
        np.concatenate([world.segments2d, world.segments2d]),
        np.concatenate([others, world.segments3d]),
    )
    assert found.status == "localized"
    assert max(world.errors(found.cam_from_world)) < OUTLIERS
    claimed = found.line_inliers[:30].astype(int) + found.line_inliers[30:]
    assert (claimed == 1).all()


def _normalised_error(world, found):
    """Squared error of the left twist in units of its covariance."""
    error = se3.log(se3.compose(world.pose[None], se3.inverse(found.cam_from_world[None])))[0]
    return float(error @ np.linalg.solve(found.covariance, error))


@pytest.mark.parametrize("kinds", [("points",), ("lines",), ("points", "lines")])
def test_covariance_covers_the_noise_of_images_and_landmarks(kinds):
    rng = np.random.default_rng(13)
    squares = []
    for _ in range(100):
        world = make_world(rng, points=60, lines=80)
        spread = rng.uniform(0.002, 0.02, 60)
        covariance = spread[:, None, None] ** 2 * np.eye(3)
        world.points2d[:] += rng.normal(0.0, 0.7, world.points2d.shape)
        world.points3d[:] += spread[:, None] * rng.normal(0.0, 1.0, (60, 3))
        way = world.segments2d[:, 1] - world.segments2d[:, 0]
        across = np.column_stack([-way[:, 1], way[:, 0]]) / np.linalg.norm(way, axis=1, keepdims=True)
        world.segments2d[:] += rng.normal(0.0, 0.5, (80, 2, 1)) * across[:, None]
        known = (covariance, None) if "points" in kinds else (None, None)
        found = pose_of(world, kinds, sigma=(0.7, 0.5), covariances=known)
        assert found.status == "localized"
        squares.append(_normalised_error(world, found))
    # Mean of 100 chi-square variables of six degrees: 6 with a standard deviation of 0.35. The covariance may be wide
    # where neighbouring residuals happen to be alike, hence the lower limit.
    assert 4.0 < np.mean(squares) < 6.0 + 3.0 * 0.35


def test_landmarks_that_are_hardly_known_count_less():
    rng = np.random.default_rng(17)
    better = 0
    for _ in range(12):
        world = make_world(rng, points=60, lines=0)
        spread = np.where(np.arange(60) < 30, 0.002, 0.1)
        world.points3d[:] += spread[:, None] * rng.normal(0.0, 1.0, (60, 3))
        told = pose_of(world, ("points",), covariances=(spread[:, None, None] ** 2 * np.eye(3), None))
        alike = pose_of(world, ("points",), sigma=(5.0, 5.0))
        better += world.errors(told.cam_from_world)[0] < world.errors(alike.cam_from_world)[0]
    assert better >= 10


def test_nothing_in_it_is_said_to_be_nothing():
    rng = np.random.default_rng(19)
    for count in (0, 1, 3, 5, 40, 300):
        pixels = rng.uniform(0, [640, 480], (count, 2))
        found = estimate_absolute_pose(CAMERA, pixels, rng.normal([0, 0, 4], 1, (count, 3)))
        assert found.status == "failed"
        assert found.cam_from_world is None
        assert found.sentence.endswith(".")


def test_no_pose_is_looked_for_where_fewer_cells_have_matches_than_must_agree(monkeypatch):
    world = make_world(np.random.default_rng(22), points=40, lines=0)
    matches = Matches(world.points2d, world.points3d)
    cells = most_votes(matches, CAMERA)
    assert pose_from_matches(CAMERA, matches, enough=cells).status == "localized"
    monkeypatch.setattr("groma.localization.pose.absolute_pose.propose", None)
    assert pose_from_matches(CAMERA, matches, enough=cells + 1).status == "failed"


def test_mirrored_matches_are_not_believed():
    rng = np.random.default_rng(23)
    for _ in range(5):
        world = make_world(rng)
        world.points2d[:, 0] = CAMERA.width - world.points2d[:, 0]
        world.segments2d[..., 0] = CAMERA.width - world.segments2d[..., 0]
        assert pose_of(world, ("points", "lines")).status != "localized"


def test_two_places_that_fit_equally_well_are_told_as_two():
    rng = np.random.default_rng(29)
    world = make_world(rng, points=60, lines=0)
    R = quaternion.to_matrix(world.pose[None, :4])[0]
    step = R.T @ [1.5, 0.0, 0.0]  # a facade that repeats
    pixels = np.concatenate([world.points2d, world.points2d])
    both = np.concatenate([world.points3d, world.points3d + step])
    found = estimate_absolute_pose(CAMERA, pixels, both)
    assert found.status == "uncertain"
    assert "Two places" in found.sentence
    assert found.cam_from_world is not None and found.rival is not None
    poses = (found.cam_from_world, found.rival)
    centers = [-quaternion.to_matrix(one[None, :4])[0].T @ one[4:] for one in poses]
    assert np.linalg.norm(centers[0] - centers[1]) == pytest.approx(1.5, abs=1e-3)
    # Where the second place has few of them, there is no doubt.
    kept = np.concatenate([np.arange(60), 60 + rng.permutation(60)[:10]])
    assert estimate_absolute_pose(CAMERA, pixels[kept], both[kept]).status == "localized"


def test_points_on_a_line_do_not_determine_a_pose():
    rng = np.random.default_rng(31)
    world = make_world(rng, points=2, lines=0)
    along = rng.uniform(0.0, 1.0, (50, 1))
    X = world.points3d[:1] + along * (world.points3d[1:] - world.points3d[:1])
    found = estimate_absolute_pose(CAMERA, project(CAMERA, world.pose, X), X)
    assert found.status != "localized"


def test_parallel_lines_alone_do_not_determine_a_pose():
    rng = np.random.default_rng(37)
    world = make_world(rng, points=0, lines=30)
    direction = world.segments3d[0, 1] - world.segments3d[0, 0]
    ends = world.segments3d[:, :1] + np.array([0.0, 0.2])[:, None] * direction
    found = estimate_absolute_pose(
        CAMERA, segments2d=project(CAMERA, world.pose, ends), segments3d=ends, sigma=(1.0, 0.5)
    )
    assert found.status != "localized"


def test_an_unknown_lens_is_estimated():
    rng = np.random.default_rng(41)
    lens = QueryCamera("SIMPLE_RADIAL", np.array([810.0, 320.0, 240.0, -0.06]), 640, 480)
    world = make_world(rng, points=150, lines=0, camera=lens)
    start = QueryCamera("SIMPLE_RADIAL", np.array([640.0, 320.0, 240.0, 0.0]), 640, 480)
    from groma.localization.pose.absolute_pose import UNKNOWN_LENS

    options = PoseOptions(refine_lens=True, focal_factors=UNKNOWN_LENS)
    found = pose_of(world, ("points",), start, options=options)
    assert found.status == "localized"
    assert found.camera.params == pytest.approx(lens.params, rel=1e-4, abs=1e-5)
    assert max(world.errors(found.cam_from_world)) < 1e-4


def test_an_estimated_lens_makes_the_pose_less_certain():
    rng = np.random.default_rng(43)
    lens = QueryCamera("SIMPLE_RADIAL", np.array([700.0, 320.0, 240.0, -0.06]), 640, 480)
    squares, sigmas = [], []
    for _ in range(40):
        world = make_world(rng, points=120, lines=0, camera=lens)
        world.points2d[:] += rng.normal(0.0, 1.0, world.points2d.shape)
        found = pose_of(world, ("points",), lens, options=PoseOptions(refine_lens=True))
        known = pose_of(world, ("points",), lens)
        assert found.center_sigma is not None and known.center_sigma is not None
        sigmas.append(np.linalg.norm(found.center_sigma) / np.linalg.norm(known.center_sigma))
        squares.append(_normalised_error(world, found))
    assert np.median(sigmas) > 1.5
    assert 3.5 < np.mean(squares) < 6.0 + 3.0 * np.sqrt(12.0 / 40.0)


def test_the_same_seed_gives_the_same_pose_and_arguments_stay():
    world = make_world(np.random.default_rng(47))
    before = world.points2d.copy(), world.segments3d.copy()
    first, second = pose_of(world, ("points", "lines")), pose_of(world, ("points", "lines"))
    assert first.cam_from_world is not None and second.cam_from_world is not None
    assert np.array_equal(first.cam_from_world, second.cam_from_world)
    assert np.array_equal(before[0], world.points2d) and np.array_equal(before[1], world.segments3d)


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        (([[1.0, 2.0]], [[1.0, 2.0]]), ShapeError, "points3d must have shape"),
        (([[1.0, np.nan]], [[1.0, 2.0, 3.0]]), InputError, "must be finite"),
        ((None, None, np.zeros((1, 2, 2)), np.zeros((1, 2, 3))), InputError, "two different places"),
    ],
)
def test_wrong_matches_are_refused(arguments, error, words):
    with pytest.raises(error, match=words):
        estimate_absolute_pose(CAMERA, *arguments)


def test_wrong_cameras_are_refused():
    with pytest.raises(InputError, match="parameters"):
        QueryCamera("PINHOLE", np.array([500.0, 320.0, 240.0]), 640, 480)
    with pytest.raises(InputError, match="positive"):
        QueryCamera("SIMPLE_PINHOLE", np.array([-500.0, 320.0, 240.0]), 640, 480)


def test_public_names():
    assert groma.estimate_absolute_pose is estimate_absolute_pose
    assert so3 is not None


def test_the_noise_of_a_fit_to_few_matches_is_not_told_too_small():
    """Residuals of five matches, six of ten directions of which the fit has taken."""
    rng = np.random.default_rng(11)
    found = []
    for _ in range(2000):
        basis = np.linalg.qr(rng.normal(size=(10, 6)))[0]
        noise = rng.normal(size=10)
        found.append(_pull((noise - basis @ (basis.T @ noise)).reshape(5, 2), 6)[1] ** 2)
    square, stiffness = _of_normal_noise(last_scale(5))
    assert np.mean(found) == pytest.approx(square / stiffness**2, rel=0.02)
