# SPDX-License-Identifier: BSD-3-Clause
"""What a map says is in a photograph, part by part of the image: in a made map whose landmarks are all known."""

from types import SimpleNamespace

import numpy as np
import pytest
from worlds import CAMERA, make_world

from groma.geometry import se3
from groma.localization.expected import FoundAgain, nearest_images, shown_of
from groma.localization.features import unit
from groma.localization.pose.matches import Matches
from groma.localization.pose.verdict import Verdict, doubted_if_missing
from groma.localization.repeated import Described, alike_limits, most_alike, telling_points
from groma.scene import Cameras

RIGHT = Verdict("localized", 1.0, "all agree.")


def _index(seen, xyz, segments=None, telling=()):
    """An index of points (rows seen by each image) and of line observations (rows of each image)."""
    segments = [[] for _ in seen] if segments is None else segments
    return SimpleNamespace(
        image=np.zeros((len(seen), 1)),
        xyz=xyz,
        telling=np.isin(np.arange(len(xyz)), telling).astype(float),
        begin=np.concatenate([[0], np.cumsum([len(rows) for rows in seen])]),
        point=np.concatenate([np.asarray(rows, np.int64) for rows in seen]),
        segment_begin=np.concatenate([[0], np.cumsum([len(rows) for rows in segments])]),
        segment=np.concatenate([np.asarray(rows, np.int64) for rows in segments]),
    )


def _scene(world, images, lines):
    table = Cameras(np.array([1]), (CAMERA.model,), CAMERA.params[None], np.array([640]), np.array([480]))
    return SimpleNamespace(
        cameras=table,
        images=SimpleNamespace(camera_idx=np.zeros(images, int)),
        cam_from_world=np.tile(world.pose, (images, 1)),
        num_lines=lines,
        lines=SimpleNamespace(segments=world.segments3d),
        line_observations=SimpleNamespace(line_idx=np.arange(lines)),
    )


def _best(world, points, lines):
    """A pose that some points and lines agree with."""
    matches = Matches(world.points2d, world.points3d, world.segments2d, world.segments3d)
    best = SimpleNamespace(camera=CAMERA, pose=world.pose, point_inliers=points, line_inliers=lines)
    return best, matches


def _parts(scene, index, rate, near, best, matches, lines=True):
    """Parts that are shown and missing, if points are found again so often."""
    found = np.flatnonzero(best.point_inliers)
    return shown_of(scene, index, FoundAgain(np.tile(rate, (2, 1))), near, best, matches, (found, found), lines)[:2]


def test_how_often_points_are_found_again_is_learned_from_the_map():
    """Every image sees each point with a probability of its own: often seen ones are found again more often."""
    rng = np.random.default_rng(0)
    world = make_world(rng, points=4000, lines=1)
    chance = np.where(np.arange(4000) < 2000, 0.9, 0.2)
    seen = [np.flatnonzero(rng.random(4000) < chance) for _ in range(8)]
    again = FoundAgain.of(_scene(world, 8, 0), _index(seen, world.points3d), 4)
    assert again.rate[0, 1] == pytest.approx(0.2, abs=0.05)
    assert again.rate[0, 4] == pytest.approx(0.9, abs=0.03)
    assert again.rate[0, 0] == 0.0
    assert not again.rate[1].any()  # none tells
    again = FoundAgain.of(_scene(world, 8, 0), _index(seen, world.points3d, telling=np.arange(2000)), 4)
    assert again.rate[1, 3] == pytest.approx(0.9, abs=0.05)
    assert again.rate[0, 3] == pytest.approx(0.2, abs=0.05)


def test_images_near_are_those_that_see_most():
    index = _index([[0, 1], [0, 1, 2], [3]], np.zeros((4, 3)))
    assert nearest_images(index, np.array([2, 0, 1]), np.array([1, 2]), 2).tolist() == [1, 0]


@pytest.mark.parametrize("lines", [False, True])
def test_parts_of_the_image_without_what_is_expected_are_counted(lines):
    """All of the map agrees in one half of the image, and nothing of it in the other."""
    world = make_world(np.random.default_rng(1), points=600, lines=200)
    seen, rows = [np.arange(600)] * 3, [np.arange(200)] * 3
    index, scene = _index(seen, world.points3d, rows), _scene(world, 3, 200 if lines else 0)
    rate, near = np.array([0.0, 0.2, 0.5, 0.9]), np.arange(3)
    every = _parts(scene, index, rate, near, *_best(world, np.ones(600, bool), np.ones(200, bool)), lines)
    assert every[0] > 40 and every[1] < 0.5
    left = world.points2d[:, 0] < 320
    inside = (world.segments2d[:, :, 0] < 320).all(axis=1)
    half = _parts(scene, index, rate, near, *_best(world, left, inside & lines), lines)
    assert sum(half) == pytest.approx(sum(every), abs=1e-9)
    assert abs(half[0] - half[1]) < 0.2 * sum(half)
    assert doubted_if_missing(RIGHT, *every) is RIGHT
    assert doubted_if_missing(RIGHT, *half).status == "uncertain"


def test_what_the_map_does_not_expect_is_no_evidence():
    """Where the map has nothing, nothing is missing; landmarks that are seldom found again say little."""
    world = make_world(np.random.default_rng(2), points=300, lines=1)
    left = np.flatnonzero(world.points2d[:, 0] < 320)
    index, scene = _index([left] * 2, world.points3d), _scene(world, 2, 0)
    best = _best(world, np.isin(np.arange(300), left), np.zeros(1, bool))
    shown, missing = _parts(scene, index, np.array([0.0, 0.0, 0.8]), np.arange(2), *best)
    assert shown > 15 and missing < 1.0
    assert _parts(scene, index, np.zeros(3), np.arange(2), *best) == (0.0, 0.0)


def test_as_much_missing_as_there_is_doubted_and_a_small_part_is_not():
    assert doubted_if_missing(RIGHT, 10.0, 0.9) is RIGHT
    assert doubted_if_missing(RIGHT, 30.0, 6.0) is RIGHT
    doubted = doubted_if_missing(RIGHT, 8.0, 3.0)
    assert doubted.status == "uncertain" and "3 of 11 parts" in doubted.sentence
    assert doubted_if_missing(RIGHT, 0.0, 5.0).status == "uncertain"
    # Of three parts the test could not say so even if all were there.
    assert doubted_if_missing(RIGHT, 2.0, 1.0) is RIGHT
    # A person before a third of a place that is seen in many parts does not matter.
    assert doubted_if_missing(RIGHT, 30.0, 12.0) is RIGHT


def test_lines_behind_the_camera_are_not_expected():
    world = make_world(np.random.default_rng(3), points=1, lines=40)
    scene, index = _scene(world, 1, 40), _index([[]], world.points3d, [np.arange(40)])
    best, matches = _best(world, np.zeros(1, bool), np.zeros(40, bool))
    assert _parts(scene, index, np.zeros(2), np.arange(1), best, matches)[1] > 10
    half_a_turn = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    best.pose = se3.compose(half_a_turn[None], world.pose[None])[0]
    assert _parts(scene, index, np.zeros(2), np.arange(1), best, matches) == (0.0, 0.0)


def test_what_only_this_place_has_is_to_be_found_as_often_as_the_rest():
    """A third of the points tell the place. The map finds 60 % of its points again, the photograph 30 %."""
    rng = np.random.default_rng(4)
    world = make_world(rng, points=1500, lines=1)
    telling = np.arange(1500) % 3 == 0
    index, scene = _index([np.arange(1500)] * 2, world.points3d, telling=np.flatnonzero(telling)), _scene(world, 2, 0)
    again = FoundAgain(np.array([[0.0, 0.0, 0.6]] * 2))

    def told(chance_telling, chance):
        agree = rng.random(1500) < np.where(telling, chance_telling, chance)
        best, matches = _best(world, agree, np.zeros(1, bool))
        shown = shown_of(scene, index, again, np.arange(2), best, matches, (np.flatnonzero(agree),) * 2)
        assert doubted_if_missing(RIGHT, *shown[:2]) is RIGHT
        return shown

    right, wrong = told(0.3, 0.3), told(0.05, 0.425)
    assert sum(right.expected) == pytest.approx(150.0, rel=0.1) and sum(right.found) == pytest.approx(150, abs=30)
    assert sum(wrong.expected) == pytest.approx(150.0, rel=0.1) and sum(wrong.found) == pytest.approx(25, abs=15)
    assert right.log_odds > 7.0 and wrong.log_odds < -7.0
    # Of points that have their like elsewhere, nine of ten views are nearer to them: they tell, and less is expected.
    index.telling[:] *= 0.9
    assert sum(told(0.3, 0.3).expected) == pytest.approx(135.0, rel=0.1)
    # A few in one part are counted by themselves, those all over the image are not.
    left = np.flatnonzero(world.points2d.max(axis=1) < 80)
    index.telling[:] = np.where(np.isin(np.arange(1500), left), 1.0, np.arange(1500) % 50 == 0)
    assert told(0.5, 0.5).expected == pytest.approx((15.0, 0.5 * len(left)), rel=0.2)
    index.telling[:] = 0.0
    assert told(0.3, 0.3).log_odds == 0.0


def test_points_tell_where_nothing_else_in_the_image_is_described_like_them():
    """Forty things, ten of which stand twice in every image; each view of a thing has noise."""
    rng = np.random.default_rng(5)
    things = rng.integers(0, 120, (40, 128))
    thing = np.concatenate([np.arange(40), np.arange(10)])  # of each of 50 points
    pixels, images = np.column_stack([np.arange(50) * 10.0, np.full(50, 100.0)]), 3
    seen = np.clip(np.tile(things[thing], (images, 1)) + rng.normal(0, 3, (150, 128)), 0, 255).astype(np.uint8)
    for upright in (False, True):
        described = Described(np.tile(np.arange(50), images), np.tile(pixels, (images, 1)), seen, np.full(150, upright))
        within, share = telling_points(*_compared(described, 640.0), 51)
        expected = np.ones(51, bool)
        expected[[*range(10), *range(40, 50)]] = False
        expected[50] = False  # nobody sees it
        np.testing.assert_array_equal(share > 0.0, expected)
        # Nothing else is near: a view of the point is what looks like it.
        assert within[expected] == pytest.approx(alike_limits(described)[int(upright)])
        assert share[expected] == pytest.approx(0.95, abs=0.02)
    # The same thing beside itself is one place.
    assert (telling_points(*_compared(described, 32.0 * 600.0), 51).share[:50] > 0.0).all()


def test_points_tell_where_their_views_are_more_alike_than_the_most_alike_other_place():
    """A second thing stands beside each, and differs from it by more or less than views of one do."""
    rng, shares = np.random.default_rng(7), []
    things = rng.integers(60, 180, (25, 128))
    pixels = np.column_stack([np.arange(50) * 10.0, np.full(50, 100.0)])
    for unlike in (2.0, 30.0):
        both = np.concatenate([things, things + rng.normal(0.0, unlike, things.shape)])
        noise = rng.uniform(1.0, 6.0, (150, 1)) * rng.normal(size=(150, 128))
        seen = np.clip(np.tile(both, (3, 1)) + noise, 0, 255).astype(np.uint8)
        described = Described(np.tile(np.arange(50), 3), np.tile(pixels, (3, 1)), seen, np.zeros(150, bool))
        within, share = telling_points(*_compared(described, 640.0), 51)
        shares.append(share[:50])
        far = np.linalg.norm(unit(seen[:50]) - unit(seen[50:100]), axis=1)
    assert shares[0].max() == 0.0
    assert (far <= within[:50]).mean() == pytest.approx(shares[1].mean(), abs=0.1)


def test_a_thing_alone_in_its_image_does_not_tell_where_another_image_shows_its_like():
    """Two things of twenty in each of two images of different places are alike."""
    rng = np.random.default_rng(6)
    things = rng.integers(0, 120, (38, 128))
    thing = np.concatenate([np.arange(20), [0, 1], np.arange(20, 38)])  # of each of 40 points, twenty an image
    seen = np.clip(np.repeat(things[thing], 2, axis=0) + rng.normal(0, 3, (80, 128)), 0, 255).astype(np.uint8)
    pixels = np.column_stack([np.tile(np.repeat(np.arange(20) * 30.0, 2), 2), np.full(80, 100.0)])
    described = Described(np.repeat(np.arange(40), 2), pixels, seen, np.zeros(80, bool))
    begin, sides = np.array([0, 40, 80]), np.full(2, 640.0)

    def nowhere(image, points):
        return np.full((len(points), 2), np.nan)

    alone = telling_points(described, begin, sides, np.zeros((2, 0), np.int64), nowhere, 40).share
    together = telling_points(described, begin, sides, np.array([[1], [0]]), nowhere, 40).share
    assert alone.all()
    np.testing.assert_array_equal(np.flatnonzero(together == 0.0), [0, 1, 20, 21])


def test_the_most_alike_images_are_others():
    images = np.eye(4, dtype=np.float32)[[0, 1, 0, 2]]
    np.testing.assert_array_equal(most_alike(images)[[0, 2], 0], [2, 0])
    assert most_alike(images[:1]).shape == (1, 0)


def _compared(described, side):
    """What :func:`telling_points` takes of three images of one place, seen at the same pixels."""
    place = described.pixel[:50]
    return described, np.arange(0, 200, 50), np.full(3, side), np.array([[1, 2], [0, 2], [0, 1]]), lambda i, p: place[p]
