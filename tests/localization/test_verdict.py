# SPDX-License-Identifier: BSD-3-Clause
"""What is said of a pose: by what agrees with it, what would by chance, and what speaks against it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, nbinom
from worlds import CAMERA, make_world, pose_of

from groma.geometry import quaternion
from groma.localization.pose.absolute_pose import (
    MapQuestions,
    MirrorQuestions,
    PoseOptions,
    estimate_absolute_pose,
    pose_from_matches,
)
from groma.localization.pose.gates import VERDICT
from groma.localization.pose.hypotheses import max_errors
from groma.localization.pose.matches import Matches
from groma.localization.pose.pieces import cells_elsewhere
from groma.localization.pose.refinement import fitted, refine
from groma.localization.pose.verdict import Shown, evidence_of, site_not_in_map, votes_of_a_rival


def _in_pieces(world, rng, moved):
    """A world whose right half is seen ``moved`` pixels from where it is; with wrong matches."""
    half = world.points2d[:, 0] > CAMERA.width / 2
    points2d = np.where(half[:, None], world.points2d + moved, world.points2d)
    wrong = rng.permutation(len(half))[: len(half) // 4]
    points2d[wrong] = rng.uniform((0, 0), (CAMERA.width, CAMERA.height), (len(wrong), 2))
    return points2d


@pytest.mark.parametrize(("kinds", "share"), [("points", 1.04), ("points lines", 0.96), ("points lines", 1.0)])
def test_a_wrong_focal_length_is_noticed(kinds, share):
    """It is told where it is wrong, and not where it is right or estimated."""
    rng, share = np.random.default_rng(21), np.array([share, share, 1.0, 1.0])
    world = make_world(rng, points=150, lines=40)
    world.points2d[:] += rng.normal(0.0, 0.5, world.points2d.shape)
    told = replace(CAMERA, params=CAMERA.params * share)
    found = pose_of(world, kinds.split(), told, sigma=(0.5, 0.5))
    wrong = share[0] != 1.0
    assert (found.status, "focal length" in found.sentence) == (("uncertain", True) if wrong else ("localized", False))
    if wrong:
        assert ("shorter" if share[0] > 1.0 else "longer") in found.sentence
    estimated = pose_of(world, kinds.split(), told, sigma=(0.5, 0.5), options=PoseOptions(refine_lens=True))
    assert estimated.status == "localized"
    np.testing.assert_allclose(estimated.camera.params[:2], CAMERA.params[:2], rtol=0.01)


def test_poses_with_too_few_votes_are_not_judged():
    """What else would be asked of them is not."""
    world = make_world(np.random.default_rng(2), points=200)
    matches = Matches(world.points2d, world.points3d)
    found = refine(CAMERA, matches, world.pose, max_errors(matches))
    votes = evidence_of(found, matches).agree
    asked = []
    for enough in (votes, votes + 1):
        expected = lambda best, used: asked.append(best) or Shown(9.0, 0.0)  # noqa: E731
        found = pose_from_matches(CAMERA, matches, enough=enough, of_map=MapQuestions(expected=expected))
        assert (found.status, len(asked)) == ("localized" if enough == votes else "failed", 1)


def test_a_pose_that_crowds_points_has_less_evidence():
    """Twelve matches agree; the pose puts the points of all others, which are seen all over the image, evenly or into a
    strip.
    """
    rng, pose = np.random.default_rng(14), np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    middle, half = CAMERA.params[2:], np.array([200.0, 150.0])
    agree = middle + rng.uniform(-1.0, 1.0, (12, 2)) * [20.0, 150.0]
    seen = np.concatenate([agree, middle + rng.uniform(-1.0, 1.0, (150, 2)) * half])
    alarms = []
    for width in (200.0, 20.0):
        put = np.concatenate([agree, middle + rng.uniform(-1.0, 1.0, (150, 2)) * [width, 150.0]])
        rays = np.column_stack([(put - middle) / CAMERA.params[:2], np.ones(len(put))])
        matches = Matches(seen, 5.0 * rays)
        alarms.append(evidence_of(fitted(CAMERA, matches, pose, max_errors(matches)), matches).log_alarms)
    # Some nine of ten factors of about ten.
    assert alarms[1] > alarms[0] + 10.0


def test_what_speaks_against_a_pose_is_told_from_too_few_matches():
    """Only the latter could be helped by more of them."""
    world = make_world(np.random.default_rng(2), points=200)
    matches = Matches(world.points2d, world.points3d)
    for parts, status in (((9.0, 0.0), "localized"), ((1.0, 9.0), "uncertain")):
        found = pose_from_matches(
            CAMERA, matches, of_map=MapQuestions(expected=lambda best, used, parts=parts: Shown(*parts))
        )
        assert found.status == status
        assert found.contradicted == found.settled == (status == "uncertain")
    again = np.concatenate([world.points3d, world.points3d + np.array([1.5, 0.0, 0.0])])
    two = estimate_absolute_pose(CAMERA, np.concatenate([world.points2d, world.points2d]), again)
    assert (two.status, two.contradicted, two.settled) == ("uncertain", False, False)


@pytest.mark.parametrize("known", [(), (0,), (1,), (0, 1)])
def test_what_only_one_of_two_places_has_decides_between_them(known):
    """All landmarks stand again beside themselves, and 120 of 300 are seen at either place alone; what tells the
    places apart is found at those that are known.
    """
    world = make_world(np.random.default_rng(3), points=300)
    shift = np.array([1.5, 0.0, 0.0])
    second = world.pose.copy()
    second[4:] -= quaternion.to_matrix(world.pose[None, :4])[0] @ shift
    # The poses see each landmark of theirs at the same pixel.
    points = world.points3d, world.points3d + shift
    matches = Matches(np.concatenate([world.points2d] * 2), np.concatenate(points))
    poses = [world.pose, second]

    def expected(best, used):
        return Shown(9.0, 0.0, (0, 30 * (nearest(best.pose) in known)), (0.0, 20.0))

    def nearest(pose):
        return int(np.argmin([np.linalg.norm(one[4:] - pose[4:]) for one in poses]))

    found = pose_from_matches(CAMERA, matches, of_map=MapQuestions(guided=lambda best: matches, expected=expected))
    if len(known) == 1:
        assert (found.status, nearest(found.cam_from_world)) == ("localized", known[0])
    else:
        words = "Two places" if known else "another place that looks like"
        assert found.status == "uncertain" and words in found.sentence
        assert found.probability == pytest.approx(0.5 if known else 0.0, abs=1e-3)


def test_what_is_put_together_of_pieces_is_not_believed():
    rng, believed = np.random.default_rng(12), []
    for _ in range(5):
        world = make_world(rng, points=300)
        pieces = estimate_absolute_pose(CAMERA, _in_pieces(world, rng, [0.0, 150.0]), world.points3d)
        assert pieces.status == "uncertain", pieces.sentence
        whole = estimate_absolute_pose(CAMERA, _in_pieces(world, rng, [0.0, 0.0]), world.points3d)
        believed.append(whole.status)
    assert believed == ["localized"] * 5


def test_points_that_tell_a_place_are_weighed_by_their_negative_binomial_distributions():
    shape = VERDICT.scatter**-2
    for found, expected in (
        ((0, 0), (0.0, 0.0)),
        ((0, 2), (3.0, 1.0)),
        ((7, 0), (8.7, 0.0)),
        ((20, 700), (11.2, 900.0)),
    ):
        odds = [
            nbinom.logpmf(k, shape, shape / (shape + E)) - nbinom.logpmf(k, shape, shape / (shape + share * E))
            for k, E, share in zip(found, expected, VERDICT.elsewhere, strict=True)
        ]
        assert Shown(9.0, 0.0, found, expected).log_odds == pytest.approx(sum(odds), rel=1e-9, abs=1e-9)


def test_another_place_is_the_more_probable_the_more_the_map_repeats_and_the_less_tells():
    """Where nothing repeats and nothing tells a pose is believed; half of the cells that repeat are even odds of a
    half, and missing points count where nothing repeats, too.
    """
    assert site_not_in_map(40, 0, Shown()).odds == pytest.approx(5e-4)
    assert site_not_in_map(40, 20, Shown()).odds == pytest.approx(0.5, abs=1e-3)
    assert site_not_in_map(40, 90, Shown()).odds == pytest.approx(1.0, abs=1e-3)
    # Where a place repeats, half of what agrees does: 4 of 23 are less than that by chance once in 770.
    few = 4 / 23 * 2.0 * binom.cdf(4, 23, 0.5)
    assert site_not_in_map(23, 4, Shown()).odds == pytest.approx(few + 5e-4, rel=1e-9)
    assert site_not_in_map(40, 0, Shown(found=(2, 0), expected=(12.0, 0.0))).odds > 0.01
    assert site_not_in_map(40, 40, Shown(found=(0, 18), expected=(0.0, 18.0))).odds < 1e-3


def test_what_is_found_at_a_place_that_is_known_is_no_piece_of_another():
    """The right half looks like what is beside it as well; near the pose what is there is found, or not."""
    world = make_world(np.random.default_rng(12), points=300)
    moved = world.points2d + np.array([0.0, 150.0])
    matches = Matches(np.where(world.points2d[:, :1] > CAMERA.width / 2, moved, world.points2d), world.points3d)
    rays = CAMERA.kind.unproject(CAMERA.params, np.ascontiguousarray(matches.points2d))
    R = quaternion.to_matrix(world.pose[None, :4])[0]
    at_the_place = Matches(matches.points2d, (rays / rays[:, 2:] * 5.0 - world.pose[4:]) @ R)
    for near, telling, status in (
        (at_the_place, 30, "localized"),
        (matches, 30, "uncertain"),
        (at_the_place, 0, "uncertain"),
    ):
        found = pose_from_matches(
            CAMERA,
            matches,
            PoseOptions(look_for_rival=False),
            of_map=MapQuestions(
                guided=lambda best, near=near: near,
                expected=lambda best, used, telling=telling: Shown(9.0, 0.0, (0, telling), (0.0, 20.0)),
            ),
        )
        assert found.status == status, found.sentence


def test_what_repeats_elsewhere_is_no_piece():
    """The right half shows the map elsewhere, by landmarks that only one place has, or by others."""
    world = make_world(np.random.default_rng(12), points=300)
    right = world.points2d[:, 0] > CAMERA.width / 2
    matches = Matches(world.points2d + right[:, None] * np.array([0.0, 150.0]), world.points3d)
    for telling, status in ((np.ones(300, bool), "uncertain"), (~right, "localized"), (right, "uncertain")):
        of_map = MapQuestions(telling=lambda used, telling=telling: telling)
        found = pose_from_matches(CAMERA, matches, PoseOptions(look_for_rival=False), of_map=of_map)
        assert found.status == status, found.sentence


def test_cells_that_are_off_like_their_neighbours_are_counted():
    rng = np.random.default_rng(13)
    world = make_world(rng, points=300, lines=0)
    pose = np.array(world.pose)
    for moved, wrong, low, high in (([0.0, 150.0], 0, 100, 160), ([0.0, 0.0], 0, 0, 0), ([0.0, 0.0], 150, 0, 20)):
        pixels = world.points2d + np.where(world.points2d[:, :1] > CAMERA.width / 2, moved, 0.0)
        rows = rng.permutation(300)[:wrong]
        pixels[rows] = rng.uniform((0, 0), (CAMERA.width, CAMERA.height), (wrong, 2))
        matches = Matches(pixels, world.points3d)
        found = fitted(CAMERA, matches, pose, (7.0, 7.0))
        assert low <= cells_elsewhere(found, matches, 34.0, np.zeros((0, 2))) <= high
        # Whatever shows the place is no piece of another.
        assert cells_elsewhere(found, matches, 34.0, pixels) == 0


def test_a_mirror_image_that_chance_would_explain_is_asked_how_alike_it_is():
    """A few points and lines place the photograph; of its mirror image four of thirty matches agree."""
    world = make_world(np.random.default_rng(14), points=6, lines=12)
    matches = Matches(world.points2d, world.points3d, world.segments2d, world.segments3d)
    mirror = make_world(np.random.default_rng(17), points=30, lines=0)
    mirror.points2d[4:] = np.random.default_rng(16).uniform((0, 0), (CAMERA.width, CAMERA.height), (26, 2))
    mirrored = Matches(mirror.points2d, mirror.points3d)
    assert pose_from_matches(CAMERA, mirrored).status == "failed"
    for closest, status in (((2, 25), "uncertain"), ((25, 2), "localized")):
        asked = MirrorQuestions(lambda step: mirrored, lambda *fits, closest=closest: closest)
        judged = pose_from_matches(CAMERA, matches, of_map=MapQuestions(mirror=asked))
        assert judged.status == status, judged.sentence


def test_a_rival_needs_so_many_votes():
    for agree in (5, 40, 400):
        votes = votes_of_a_rival(agree)
        assert 2.0 * binom.cdf(votes, agree + votes, 0.5) > 1e-3
        assert votes == 0 or 2.0 * binom.cdf(votes - 1, agree + votes - 1, 0.5) <= 1e-3
