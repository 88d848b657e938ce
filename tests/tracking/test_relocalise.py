# SPDX-License-Identifier: BSD-3-Clause
"""Parts of finding a pose: features paired near expected places, depths read, poses proposed among wrong matches."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from groma.features.depth.points import DEPTH_POINTS, depth_at
from groma.geometry import se3
from groma.tracking.frame.camera import TrackCamera, into
from groma.tracking.frame.descriptor_pairs import PlacedFeatures, pair_anywhere, pair_near
from groma.tracking.gates import DEFAULT
from groma.tracking.pose.relocalise import PoseSearch, pose_from_matches

CAMERA = TrackCamera(525.0, 525.0, 320.0, 240.0, 640, 480)


def _pairs_by_hand(expected, first, pixel, second, radius, max_bits):
    away = np.linalg.norm(expected[:, None] - pixel[None], axis=2)
    bits = np.unpackbits(first[:, None] ^ second[None], axis=2).sum(axis=2)
    cost = np.where((away <= radius) & (bits <= max_bits), bits + 1e-4 * away, np.inf)
    best, other = cost.argmin(axis=1), cost.argmin(axis=0)
    rows = [i for i in range(len(expected)) if np.isfinite(cost[i, best[i]]) and other[best[i]] == i]
    rows.sort(key=lambda i: cost[i, best[i]])
    return np.array([(i, best[i]) for i in rows])


@pytest.mark.parametrize("radius", [6.0, 90.0])
def test_pairs_are_the_most_alike_for_both(radius):
    rng = np.random.default_rng(0)
    pixel = rng.uniform((0, 0), (640, 480), (300, 2))
    second = rng.integers(0, 256, (300, 32), dtype=np.uint8)
    of = rng.integers(0, 300, 500)  # some are expected twice
    expected = pixel[of] + rng.normal(0, 4.0, (500, 2))
    first = second[of] ^ np.packbits(rng.random((500, 256)) < 0.1, axis=1)
    found = pair_near(expected, first, PlacedFeatures.of(pixel, second), radius, 64)
    np.testing.assert_array_equal(found, _pairs_by_hand(expected, first, pixel, second, radius, 64))
    assert len(found) > 50


def test_pairs_anywhere_are_those_of_opencv():
    """Of 400 descriptors some are seen again with bits flipped, some twice, and some as often as by chance."""
    rng = np.random.default_rng(2)
    first = rng.integers(0, 256, (400, 32), dtype=np.uint8)
    first[5] = first[6]
    flips = np.packbits(rng.random((500, 256)) < rng.uniform(0.0, 0.35, (500, 1)), axis=1)
    second = first[rng.integers(0, 300, 500)] ^ flips
    second[::7] = first[5] ^ flips[0]  # as near to the same ones
    for max_bits in (64, 100):
        known = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(first, second)
        wanted = [(pair.queryIdx, pair.trainIdx) for pair in known if pair.distance <= max_bits]
        np.testing.assert_array_equal(np.column_stack(pair_anywhere(first, second, max_bits)), wanted)
        assert len(wanted) > 100


def test_nothing_pairs_with_nothing():
    nobody = np.zeros((0, 32), np.uint8)
    for both in ((nobody, nobody), (np.zeros((1, 32), np.uint8), nobody)):
        for one, other in (both, both[::-1]):
            assert [len(rows) for rows in pair_anywhere(one, other, 64)] == [0, 0]
    none, words = np.zeros((0, 2)), np.zeros((0, 32), np.uint8)
    nothing = PlacedFeatures.of(none, words)
    assert pair_near(none, words, nothing, 10.0, 64).shape == (0, 2)
    one = np.array([[5.0, 5.0]]), np.zeros((1, 32), np.uint8)
    assert pair_near(*one, nothing, 10.0, 64).shape == (0, 2)
    assert pair_near(none, words, PlacedFeatures.of(*one), 10.0, 64).shape == (0, 2)


def test_what_is_expected_nowhere_or_outside_pairs_with_nothing():
    pixel, words = np.array([[3.0, 2.0], [300.0, 200.0]]), np.zeros((2, 32), np.uint8)
    expected = np.array([[np.nan, np.nan], [-2.0, -1.0], [1e300, 200.0], [-40.0, 2.0], [300.0, np.inf], [3.0, -1e9]])
    found = pair_near(expected, np.zeros((6, 32), np.uint8), PlacedFeatures.of(pixel, words), 10.0, 64)
    np.testing.assert_array_equal(found, [[1, 0]])


def test_of_pairs_that_are_as_good_those_of_the_first_count():
    pixel = np.array([[50.0, 20.0], [40.0, 20.0], [45.0, 15.0], [45.0, 25.0]])  # all five pixels away
    words = np.zeros((4, 32), np.uint8)
    found = pair_near(np.array([[45.0, 20.0]] * 2), words[:2], PlacedFeatures.of(pixel, words), 5.0, 0)
    np.testing.assert_array_equal(found, [[0, 0]])


def test_a_pose_is_proposed_where_three_matches_of_four_are_wrong():
    rng = np.random.default_rng(1)
    found = 0
    for _ in range(10):
        places = rng.uniform((-2.0, -1.5, 1.5), (2.0, 1.5, 5.0), (240, 3))
        pose = se3.exp(np.concatenate([0.2 * rng.normal(size=3), 0.1 * rng.normal(size=3)])[None])[0]
        pixel = CAMERA.project(into(pose, places)) + rng.normal(size=(240, 2))
        wrong = np.arange(240) >= 60
        pixel[wrong] = rng.uniform((0, 0), (640, 480), (180, 2))
        proposal = pose_from_matches(CAMERA, places, pixel)
        if proposal is not None:
            error = se3.log(se3.compose(proposal[0][None], se3.inverse(pose[None])))[0]
            found += np.linalg.norm(error[:3]) < 0.1 and np.linalg.norm(error[3:]) < 0.03
    assert found >= 9


def test_what_agrees_in_one_cell_of_the_image_is_no_pose():
    """Twelve right matches within ten pixels count once; spread over the image they are enough."""
    rng = np.random.default_rng(5)
    for spread, is_found in ((10.0, False), (400.0, True)):
        middle = np.array([325.0, 245.0])
        right = middle + spread * (rng.random((12, 2)) - 0.5)
        pixel = np.concatenate([right, rng.uniform((0, 0), (640, 480), (20, 2))])
        places = CAMERA.bearings(pixel) * rng.uniform(1.5, 4.0, (32, 1))
        places[12:] = places[12:][rng.permutation(20)]
        found = pose_from_matches(CAMERA, places, pixel)
        assert (found is not None) == is_found


def test_depths_are_medians_of_what_is_known_and_alike():
    rng = np.random.default_rng(2)
    image = (2.0 + 0.01 * rng.normal(size=(60, 80))).astype(np.float32)
    image[rng.random(image.shape) < 0.4] = 0.0
    image[:, 40:] += np.where(image[:, 40:] > 0, 1.0, 0.0).astype(np.float32)
    image[20:23, 10] = np.nan
    pixels = rng.uniform(-2.0, 82.0, (400, 2))
    found = depth_at(image, pixels, 2.9)
    for (u, v), depth in zip(pixels, found, strict=True):
        column, row = int(np.clip(int(u), 1, 78)), int(np.clip(int(v), 1, 58))
        near = image[row - 1 : row + 2, column - 1 : column + 2].astype(float)
        near = near[near > 0]
        gates = DEPTH_POINTS
        good = len(near) >= max(gates.min_known, 1) and np.ptp(near) < gates.jump + gates.jump_share * near.min()
        expected = np.median(near) if good and np.median(near) <= 2.9 else np.nan
        np.testing.assert_equal(depth, expected)
    assert 50 < np.isfinite(found).sum() < 350


def _search(agreeing, scores):
    """A search in which poses, told by their x, agree with so many features, and score so much once refined."""
    search = object.__new__(PoseSearch)
    search.gates, search._best, search._tried = DEFAULT.finding, None, []
    search.track_map = SimpleNamespace(near=SimpleNamespace(depth=1.0))
    search._agreeing = lambda pose: agreeing[pose[4]]
    search.refine = lambda pose: SimpleNamespace(score=scores[pose[4]], estimate=SimpleNamespace(pose=pose))
    return search


@pytest.mark.parametrize(("others", "best"), [(371, 2.0), (353, 1.0)])
def test_poses_that_about_as_much_agrees_with_are_both_refined(others, best):
    """One bar of a radiator away 393 features agree, at the right pose 371: the better fit wins. 353 are fewer."""
    wrong, right = (np.array([0, 0, 0, 1.0, x, 0, 0]) for x in (1.0, 2.0))
    search = _search({1.0: 393.0, 2.0: float(others)}, {1.0: 366.0, 2.0: 375.0})
    search.best_of([wrong], 1)
    assert search.best_of([right], 4).estimate.pose[4] == best
