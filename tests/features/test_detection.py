# SPDX-License-Identifier: BSD-3-Clause
"""Covers segment detection: pixel shift, direction, standard deviation and merging on renderings with exact edges.

Also: turned and enlarged images, colour, images without edges, tiny images, determinism, refused options.
"""

import cv2
import numpy as np
import pytest
from _renderings import box_image, coverage, distance_to_edges, edges_of, rectangle, segment_on, steps, to_uint8

from groma.errors import InputError, ShapeError
from groma.features import LsdDetector, SegmentDetector, Segments
from groma.features.edge_fit import measure_edges
from groma.features.images import to_gray
from groma.features.merging import MergeGates, merge_collinear

pytestmark = pytest.mark.kernels


def _signed_errors(detector, seed, count, noise):
    """End points' distances from the true edges, the edges' outward normals, sigma; boxes bright and dark in turn."""
    rng = np.random.default_rng(seed)
    distances, normals, sigmas = [], [], []
    for k in range(count):
        image, corners = box_image(rng, noise, *((60.0, 190.0) if k % 2 else (190.0, 60.0)))
        found = detector.detect(image)
        found = found.select(found.length > 30.0)
        distance, nearest, outward = distance_to_edges(found.ends, corners)
        assert len(set(nearest.tolist())) == 4, "all four edges of the box must be found"
        distances.append(distance)
        normals.append(outward[nearest])
        sigmas.append(found.sigma)
    return np.concatenate(distances), np.concatenate(normals), np.concatenate(sigmas)


@pytest.mark.parametrize("scale", [0.5, 0.8, 1.0])
@pytest.mark.parametrize("fit", [False, True])
def test_no_shift_remains_against_exact_edges(scale, fit):
    detector = LsdDetector(scale=scale, fit=fit)
    distances, normals, _ = _signed_errors(detector, seed=1, count=12, noise=1.0)
    # The shift that explains the distances best; an eighth of a pixel (0.5 in place of 0.5 / 0.8) would show.
    shift = np.linalg.lstsq(np.repeat(normals, 2, axis=0), distances.ravel(), rcond=None)[0]
    assert np.abs(shift).max() < 0.01
    assert np.sqrt((distances**2).mean()) < (0.02 if fit else 0.06)
    # Neither outwards nor inwards; unfitted, the region LSD grows rounds the corners of a reduced box a little.
    assert abs(distances.mean()) < (0.01 if fit else 0.04)


def test_an_axis_parallel_edge_is_placed_at_every_fraction_of_a_pixel():
    for fraction in (0.0, 0.2, 0.45, 0.7):
        corners = np.array([[20.0, 20.0 + fraction], [100.0, 20.0 + fraction], [100.0, 80.0], [20.0, 80.0]])
        found = LsdDetector().detect(to_uint8(50.0 + 150.0 * coverage(corners, 120, 100, 20)))
        top = found.ends[np.abs(found.ends[:, [1, 3]] - corners[0, 1]).max(axis=1) < 2.0]
        assert len(top) == 1
        np.testing.assert_allclose(top[0, [1, 3]], corners[0, 1], atol=0.035)  # a sharp edge is undersampled


@pytest.mark.compiled
def test_sigma_agrees_with_the_errors_made():
    for noise in (4.0, 12.0):
        distances, _, sigma = _signed_errors(LsdDetector(min_length=15.0), seed=7, count=16, noise=noise)
        fitted = sigma < 0.5
        assert fitted.mean() > 0.95
        ratio = np.sqrt(((distances[fitted] / sigma[fitted, None]) ** 2).mean())
        # Sigma holds a floor and a prior for real photographs, so it is on the safe side on clean renderings.
        assert 0.25 < ratio < 1.3, f"error / sigma = {ratio:.2f} at noise {noise}"


def test_the_chord_of_an_arc_is_uncertain():
    """A segment on a circle is as uncertain as its ends are off the fitted line; one on a straight edge is not."""
    angle = np.linspace(0.0, 2.0 * np.pi, 721)[:-1]
    disc = 60.0 + 130.0 * coverage(100.0 + 90.0 * np.column_stack([np.cos(angle), np.sin(angle)]), 200, 200, 4)
    half = 15.0
    sagitta = 90.0 - np.sqrt(90.0**2 - half**2)
    chord = np.array([[190.0 - sagitta / 2, 100.0 - half, 190.0 - sagitta / 2, 100.0 + half]])
    straight = 60.0 + 130.0 * coverage([[20, 20], [190, 20], [190, 180], [20, 180]], 200, 200, 4)
    bent = measure_edges(to_uint8(disc), chord)[1]
    level = measure_edges(to_uint8(straight), np.array([[190.0, 85.0, 190.0, 115.0]]))[1]
    assert 0.5 * sagitta * 2 / 3 < bent[0] < 1.5 * sagitta * 2 / 3
    assert level[0] < 0.3 * bent[0]


def test_two_edges_at_an_obtuse_corner_stay_two():
    corners = np.array([[10.0, 60], [150, 20], [290, 50], [290, 190], [10, 190]])
    image = to_uint8(30.0 + 90.0 * coverage(corners, 300, 200, 4), np.random.default_rng(3), 2.0)
    found = LsdDetector(min_length=30).detect(image)
    distance = np.abs(distance_to_edges(found.ends, corners)[0]).max(axis=1)
    assert len(found) >= 5
    assert distance.max() < 0.5


@pytest.mark.compiled
@pytest.mark.parametrize("blur", [2.2, 3.0])
@pytest.mark.parametrize("length", [25.0, 80.0])
def test_sigma_of_soft_edges_holds_what_the_fit_keeps_of_an_error_of_the_segment(blur, length):
    """Segments 0.2 px off. Without that part the ratio is 1.2 to 2.0; 24 draws of two ends know it to a fifth."""
    rng, ratios = np.random.default_rng(3), []
    for _ in range(24):
        angle, at = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-1.0, 1.0)
        image = to_uint8(steps(angle, [at], [80.0], 60.0, blur), rng, 2.0)
        ends, sigma, _ = measure_edges(image, segment_on(angle, at + rng.normal(0.0, 0.2), length))
        across = np.array([-np.sin(angle), np.cos(angle)])
        ratios.append(((ends.reshape(2, 2) - 48.0) @ across - at) / sigma)
    assert 0.35 < np.sqrt(np.mean(np.square(ratios))) < 1.1


def test_sigma_grows_with_noise():
    quiet = _signed_errors(LsdDetector(), seed=3, count=6, noise=2.0)[2]
    loud = _signed_errors(LsdDetector(), seed=3, count=6, noise=20.0)[2]
    assert np.median(loud) > 1.3 * np.median(quiet)  # above the floor of 0.03 that both share


def test_the_dark_side_lies_to_the_left():
    rng = np.random.default_rng(5)
    for dark, bright, sign in ((40.0, 200.0, -1.0), (200.0, 40.0, 1.0)):
        image, corners = box_image(rng, 0.0, dark, bright)
        found = LsdDetector().detect(image)
        line, center = found.line, corners.mean(axis=0)
        side = line[:, :2] @ center + line[:, 2]  # positive: the box is on the right, so it must be the bright one
        assert (side * -sign > 0.0).all()


def test_turning_the_image_by_a_quarter_turns_the_segments():
    image, _ = box_image(np.random.default_rng(11), 2.0)
    before = LsdDetector().detect(image)
    after = LsdDetector().detect(np.ascontiguousarray(np.rot90(image)))  # counter-clockwise: (u, v) -> (v, W - u)
    width = image.shape[1]
    turned = np.stack([before.ends[:, 1], width - before.ends[:, 0], before.ends[:, 3], width - before.ends[:, 2]], 1)
    assert len(before) == len(after) == 4
    for row in turned:
        assert np.abs(after.ends - row).max(axis=1).min() < 2.0  # end points along the edge: LSD's rounding
    lines = Segments.from_ends(turned).line
    for line in after.line:
        assert np.abs(lines - line).max(axis=1).min() < 0.15


def test_enlarging_the_image_enlarges_the_segments():
    _, corners = box_image(np.random.default_rng(2), 0.0)
    for factor in (1.0, 1.5, 2.0):
        size = int(160 * factor)
        found = LsdDetector().detect(to_uint8(60.0 + 130.0 * coverage(corners * factor, size, size)))
        assert len(found) == 4
        distances, nearest, _ = distance_to_edges(found.ends, corners * factor)
        assert np.abs(distances).max() < 0.06
        lengths = np.linalg.norm(edges_of(corners)[:, 2:] - edges_of(corners)[:, :2], axis=1) * factor
        np.testing.assert_allclose(found.length, lengths[nearest], atol=6.0)


def test_strength_is_the_gradient_across():
    ramp = np.clip((np.arange(120) - 57.0) * 25.0, 0.0, 150.0) + 40.0  # 6 pixels wide, 25 grey levels a pixel
    image = to_uint8(np.repeat(ramp[None], 100, axis=0))
    _, _, strength = measure_edges(image, np.array([[60.5, 20.0, 60.5, 80.0]]))
    np.testing.assert_allclose(strength, 25.0, rtol=0.02)


def test_length_and_strength_filters_and_order():
    image, _ = box_image(np.random.default_rng(4), 1.0, dark=100.0, bright=130.0)
    every = LsdDetector(min_strength=0.0).detect(image)
    assert len(every) >= 4
    assert (np.diff(every.length) <= 0.0).all()
    assert len(LsdDetector(min_strength=30.0).detect(image)) == 0
    assert (LsdDetector(min_length=70.0).detect(image).length >= 70.0).all()
    assert len(LsdDetector(max_segments=2).detect(image)) == 2


@pytest.mark.parametrize("shape", [(1, 1), (1, 200), (3, 5), (7, 7), (8, 8), (9, 64), (480, 640)])
@pytest.mark.parametrize("value", [0, 255])
def test_images_without_edges_give_nothing(shape, value):
    found = LsdDetector().detect(np.full(shape, value, dtype=np.uint8))
    assert len(found) == 0
    assert found.ends.shape == (0, 4)
    assert found.line.shape == (0, 3)


@pytest.mark.parametrize("shape", [(1, 1), (2, 2), (8, 8), (9, 33), (12, 12)])
def test_tiny_noisy_images_do_not_fail(shape):
    image = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    found = LsdDetector(min_length=2.0, min_strength=0.0).detect(image)
    assert np.isfinite(found.ends).all()
    assert (found.ends >= 0.0).all() and (found.ends <= [shape[1], shape[0]] * 2).all()


def test_colour_and_other_types_agree_with_grey():
    gray, _ = box_image(np.random.default_rng(9), 3.0)
    expected = LsdDetector().detect(gray).ends
    assert len(expected) == 4
    for image in (
        np.repeat(gray[..., None], 3, axis=2),
        gray[..., None],
        cv2.cvtColor(gray, cv2.COLOR_GRAY2BGRA),
        gray.astype(np.uint16) * 257,
        np.round(gray * (4095 / 255)).astype(np.uint16),
        gray / 255.0,
        gray.astype(np.float32),
        np.asfortranarray(gray),
    ):
        np.testing.assert_array_equal(LsdDetector().detect(image).ends, expected)


def test_detection_is_deterministic_and_leaves_the_image():
    image, _ = box_image(np.random.default_rng(8), 10.0)
    kept = image.copy()
    first, second = LsdDetector().detect(image), LsdDetector().detect(image)
    np.testing.assert_array_equal(first.ends, second.ends)
    np.testing.assert_array_equal(first.sigma, second.sigma)
    np.testing.assert_array_equal(image, kept)


def test_a_broken_edge_is_joined_and_a_corner_is_not():
    corners = rectangle((150.0, 60.0), (120.0, 30.0), 0.05)
    image = 60.0 + 130.0 * coverage(corners, 300, 120)
    post = coverage(rectangle((150.0, 60.0), (1.5, 60.0), 0.0), 300, 120)
    image = to_uint8(image * (1.0 - post) + 20.0 * post)
    pieces, whole = LsdDetector(merge=False).detect(image), LsdDetector().detect(image)
    assert whole.length.max() > 220.0 > 1.5 * pieces.length.max()
    distances, _, _ = distance_to_edges(whole.ends[:2], corners)
    assert np.abs(distances).max() < 0.05


def test_merging_joins_only_what_is_collinear_and_alike():
    chain = np.array([[0.0, 0.0, 30.0, 0.0], [33.0, 0.1, 70.0, 0.2], [75.0, 0.1, 90.0, 0.0]])
    np.testing.assert_allclose(merge_collinear(chain), [[0.0, 0.0, 90.0, 0.0]], atol=0.2)
    against = np.array([[0.0, 0.0, 30.0, 0.0], [70.0, 0.0, 33.0, 0.0]])  # dark sides differ
    far = np.array([[0.0, 0.0, 30.0, 0.0], [45.0, 0.0, 70.0, 0.0]])
    beside = np.array([[0.0, 0.0, 30.0, 0.0], [33.0, 2.0, 70.0, 2.0]])
    bent = np.array([[0.0, 0.0, 30.0, 0.0], [33.0, 0.0, 70.0, 5.0]])
    for apart in (against, far, beside, bent):
        np.testing.assert_array_equal(merge_collinear(apart), apart)
    steps = np.linspace(0.0, 1.2, 25)  # an arc of short pieces: each neighbour fits, the whole does not
    arc = 100.0 * np.stack([np.cos(steps), np.sin(steps)], axis=1)
    pieces = np.hstack([arc[:-1], arc[1:]])
    np.testing.assert_array_equal(merge_collinear(pieces, MergeGates(angle=0.1)), pieces)


def test_fitting_leaves_what_has_no_edge():
    flat = np.full((60, 60), 90, dtype=np.uint8)
    ends = np.array([[10.0, 10.0, 50.0, 20.0], [5.0, 5.0, 5.0, 5.0], [-20.0, 3.0, 90.0, 3.0]])
    moved, sigma, strength = measure_edges(flat, ends)
    np.testing.assert_array_equal(moved, ends)
    assert (sigma == 0.5).all() and (strength == 0.0).all()


def test_segments_and_detector_contract():
    assert isinstance(LsdDetector(), SegmentDetector)
    segments = Segments.from_ends(np.array([[0.0, 0.0, 3.0, 4.0], [1.0, 1.0, 1.0, 3.0]]))
    np.testing.assert_allclose(segments.length, [5.0, 2.0])
    np.testing.assert_allclose(segments.midpoint[0], [1.5, 2.0])
    np.testing.assert_allclose(segments.select(np.array([1])).direction, [[0.0, 1.0]])
    assert len(segments.select(segments.length > 3.0)) == 1


def test_refusals_name_the_cure():
    with pytest.raises(ShapeError, match="Did the file open"):
        to_gray(np.zeros((0, 5), dtype=np.uint8))
    with pytest.raises(ShapeError, match=r"\(H, W, 3\)"):
        to_gray(np.zeros((5, 5, 2), dtype=np.uint8))
    with pytest.raises(InputError, match="uint8"):
        to_gray(np.zeros((5, 5), dtype=np.int32))
    with pytest.raises(InputError, match="finite"):
        to_gray(np.full((5, 5), np.nan))
    with pytest.raises(InputError, match="min_length"):
        LsdDetector(min_length=0.0)
    with pytest.raises(InputError, match="scale"):
        LsdDetector(scale=0.0)
    with pytest.raises(InputError, match="min_strength"):
        LsdDetector(min_strength=-1.0)
    with pytest.raises(InputError, match="max_segments"):
        LsdDetector(max_segments=-1)
    with pytest.raises(ShapeError, match=r"\(N, 4\)"):
        Segments(np.zeros((3, 5)), np.ones(3), np.ones(3))
    with pytest.raises(ShapeError, match="sigma"):
        Segments(np.zeros((3, 4)), np.ones(2), np.ones(3))
    with pytest.raises(InputError, match="positive"):
        Segments(np.zeros((1, 4)), np.zeros(1), np.ones(1))
    with pytest.raises(InputError, match="NaN"):
        Segments(np.full((1, 4), np.nan), np.ones(1), np.ones(1))
