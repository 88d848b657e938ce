# SPDX-License-Identifier: BSD-3-Clause
"""Covers descriptors and both matchers on warps with known truth, epipolar gates, nearby points, and files of matches.

The truth of a match: the segment's end points, carried by the warp, lie on its partner's line and overlap it.
"""

import cv2
import numpy as np
import pytest
from _renderings import board, to_uint8

from groma.errors import FileFormatError, InputError, OutputError, ShapeError
from groma.features import (
    ExternalMatches,
    FlowOptions,
    LineMatches,
    LsdDetector,
    Segments,
    WideBaselineOptions,
    dense_flow,
    describe,
    fundamental_from_poses,
    match_by_flow,
    match_wide_baseline,
    nearby_points,
    read_matches,
    write_matches,
)

pytestmark = pytest.mark.kernels
MILD = np.array([[1.01, 0.02, 3.0], [-0.015, 0.99, 4.0], [0.0, 0.0, 1.0]])
STRONG = np.array([[0.88, 0.22, -6.0], [-0.18, 0.97, 42.0], [2.5e-4, -2e-4, 1.0]])


def _carry(H, points):
    moved = np.column_stack([points, np.ones(len(points))]) @ H.T
    return moved[:, :2] / moved[:, 2:]


def _warped(H, seed=0, gain=1.0, offset=0.0, noise=2.0):
    """An image, the same seen through H (pixels count from the corner), and their segments."""
    rng = np.random.default_rng(seed)
    scene = board(rng)
    half = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    seen = cv2.warpPerspective(scene, np.linalg.inv(half) @ H @ half, (320, 240), borderMode=cv2.BORDER_REPLICATE)
    images = to_uint8(scene, rng, noise), to_uint8(gain * seen + offset, rng, noise)
    return images, tuple(LsdDetector(min_length=12.0).detect(image) for image in images)


def _true_pairs(H, one, two):
    """(N1, N2) whether the carried segment lies on the other, directed alike."""
    ends = np.hstack([_carry(H, one.ends[:, :2]), _carry(H, one.ends[:, 2:])])
    carried = Segments.from_ends(ends)
    distance = np.zeros((len(one), len(two)))
    for k in (0, 2):
        on_line = (two.ends[None, :, k : k + 2] * carried.line[:, None, :2]).sum(-1) + carried.line[:, None, 2]
        distance = np.maximum(distance, np.abs(on_line))
    along = ((two.ends.reshape(-1, 1, 2, 2) - carried.midpoint[:, None]) * carried.direction[:, None]).sum(-1)
    along = along.transpose(1, 0, 2)
    half = carried.length[:, None] / 2.0
    common = np.minimum(along.max(-1), half) - np.maximum(along.min(-1), -half)
    alike = carried.direction @ two.direction.T > 0.95
    return (distance < 2.0) & alike & (common > 0.3 * np.minimum(carried.length[:, None], two.length))


def _precision_recall(matches, truth):
    right = truth[matches.pairs[:, 0], matches.pairs[:, 1]].sum()
    return right / max(len(matches), 1), right / truth.any(axis=1).sum()


def _point_matches(H, seed=1, count=150, wrong=0.1):
    rng = np.random.default_rng(seed)
    points = rng.uniform([0, 0], [320, 240], (count, 2))
    moved = _carry(H, points) + rng.normal(0.0, 0.5, (count, 2))
    moved[: int(wrong * count)] = rng.uniform([0, 0], [320, 240], (int(wrong * count), 2))
    return np.hstack([points, moved])


# ---------------------------------------------------------------------------------------------------- Descriptors
@pytest.mark.compiled
def test_descriptor_ignores_brightness_and_contrast():
    rng = np.random.default_rng(3)
    scene = board(rng)
    plain, changed = to_uint8(0.4 * scene + 60.0), to_uint8(0.8 * scene + 20.0)
    segments = LsdDetector(min_length=12.0, min_strength=0.0).detect(plain)
    assert len(segments) > 20
    one, two = describe(plain, segments), describe(changed, segments)
    assert one.shape == (len(segments), 72)
    np.testing.assert_allclose(np.linalg.norm(one, axis=1), 1.0, atol=1e-5)
    assert np.linalg.norm(one - two, axis=1).max() < 0.12  # rounding to grey levels only


@pytest.mark.compiled
def test_descriptor_turns_with_the_image():
    image = to_uint8(board(np.random.default_rng(4)))
    segments = LsdDetector(min_length=12.0).detect(image)
    turned = np.ascontiguousarray(np.rot90(image))
    e, width = segments.ends, image.shape[1]
    there = Segments.from_ends(np.stack([e[:, 1], width - e[:, 0], e[:, 3], width - e[:, 2]], axis=1))
    assert np.linalg.norm(describe(image, segments) - describe(turned, there), axis=1).max() < 0.2


@pytest.mark.compiled
def test_descriptor_scale_undoes_an_enlargement():
    image = to_uint8(board(np.random.default_rng(6)))
    segments = LsdDetector(min_length=15.0).detect(image)
    large = cv2.resize(image, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_LINEAR)
    there = Segments.from_ends(segments.ends * 2.0)
    near = np.linalg.norm(describe(image, segments) - describe(large, there, scale=2.0), axis=1)
    far = np.linalg.norm(describe(image, segments) - describe(large, there), axis=1)
    assert np.median(near) < 0.6 * np.median(far)


def test_descriptor_of_nothing_is_zero():
    flat = np.full((40, 40), 77, dtype=np.uint8)
    segments = Segments.from_ends(np.array([[5.0, 5.0, 35.0, 20.0], [-30.0, -30.0, -5.0, -9.0]]))
    np.testing.assert_array_equal(describe(flat, segments), np.zeros((2, 72)))
    assert describe(flat, Segments.empty()).shape == (0, 72)
    with pytest.raises(InputError, match="positive"):
        describe(flat, segments, scale=0.0)


# -------------------------------------------------------------------------------------------------- Wide baseline
@pytest.mark.compiled
@pytest.mark.parametrize("H", [MILD, STRONG], ids=["mild", "strong"])
def test_wide_baseline_on_a_warp(H):
    images, (one, two) = _warped(H, gain=0.8, offset=15.0)
    first, second = describe(images[0], one), describe(images[1], two)
    truth = _true_pairs(H, one, two)
    assert truth.any(axis=1).sum() > 20
    precision, recall = _precision_recall(match_wide_baseline(one, two, first, second, _point_matches(H)), truth)
    assert precision > 0.9
    assert recall > 0.7


@pytest.mark.compiled
def test_matches_are_one_to_one_scored_deterministic_and_symmetric():
    images, (one, two) = _warped(STRONG, seed=2)
    first, second, points = describe(images[0], one), describe(images[1], two), _point_matches(STRONG)
    found = match_wide_baseline(one, two, first, second, points)
    assert len(found) > 10
    assert len(np.unique(found.pairs[:, 0])) == len(np.unique(found.pairs[:, 1])) == len(found)
    assert ((found.score >= 0.5) & (found.score <= 1.0)).all()
    again = match_wide_baseline(one, two, first, second, points)
    np.testing.assert_array_equal(found.pairs, again.pairs)
    back = match_wide_baseline(two, one, second, first, points[:, [2, 3, 0, 1]]).swapped()
    assert {tuple(p) for p in back.pairs.tolist()} == {tuple(p) for p in found.pairs.tolist()}


def _two_views(rng, count=40):
    """Random 3D segments seen by two cameras: segments without any image, and the fundamental matrix."""
    K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
    turn = cv2.Rodrigues(np.array([0.05, -0.25, 0.04]))[0]
    poses = np.eye(3, 4), np.hstack([turn, [[-1.0], [0.1], [0.1]]])
    start = rng.uniform([-2.0, -1.5, 5.0], [2.0, 1.5, 9.0], (count, 3))
    end = start + rng.normal(0.0, 0.6, (count, 3))
    views = []
    for pose in poses:
        pixels = [(X @ pose[:, :3].T + pose[:, 3]) @ K.T for X in (start, end)]
        views.append(Segments.from_ends(np.hstack([x[:, :2] / x[:, 2:] for x in pixels])))
    return views, fundamental_from_poses(*poses, K, K), K, poses


def test_fundamental_matrix_holds_points_on_their_epipolar_lines():
    (one, two), F, _, _ = _two_views(np.random.default_rng(0))
    x1 = np.column_stack([one.ends[:, :2], np.ones(len(one))])
    x2 = np.column_stack([two.ends[:, :2], np.ones(len(two))])
    lines = x1 @ F.T
    assert np.abs((lines * x2).sum(axis=1) / np.linalg.norm(lines[:, :2], axis=1)).max() < 1e-9


def test_epipolar_beam_keeps_truth_and_removes_the_rest():
    (one, two), F, _, _ = _two_views(np.random.default_rng(1), count=60)
    same = np.zeros((60, 72), dtype=np.float32)
    same[:, 0] = 1.0  # surroundings that say nothing
    from groma.features.matching.wide_baseline import candidates

    pairs, features = candidates(one, two, same, same, None, F, WideBaselineOptions())
    kept = {tuple(p) for p in pairs.tolist()}
    assert all((k, k) in kept for k in range(60))
    assert len(kept) < 0.3 * 60 * 60
    true = features[pairs[:, 0] == pairs[:, 1]]
    known = true[:, 4] >= 0.0
    assert known.mean() > 0.8
    np.testing.assert_allclose(true[known, 4:], 1.0, atol=1e-6)
    against = Segments.from_ends(np.roll(two.ends, 2, axis=1))  # directed the other way: the dark side disagrees
    pairs, features = candidates(one, against, same, same, None, F, WideBaselineOptions())
    diagonal = features[pairs[:, 0] == pairs[:, 1]]
    assert (diagonal[:, 4] < 0.0).all()  # only those without an overlap to judge by


def test_epipolar_overlap_is_the_common_share():
    (one, two), F, K, poses = _two_views(np.random.default_rng(5), count=1)
    ends = np.repeat(two.ends, 3, axis=0)
    along = two.ends[0, 2:] - two.ends[0, :2]
    ends[1, 2:] = two.ends[0, :2] + 0.5 * along  # half of it was found: all of the shorter is common
    ends[2] = np.concatenate([two.ends[0, :2] + 1.2 * along, two.ends[0, :2] + 2.0 * along])  # another piece
    same = np.eye(1, 72, dtype=np.float32)
    from groma.features.matching.wide_baseline import candidates

    pairs, features = candidates(
        one, Segments.from_ends(ends), same, np.repeat(same, 3, axis=0), None, F, WideBaselineOptions()
    )
    assert pairs[:, 1].tolist() == [0, 1]
    np.testing.assert_allclose(features[:, 4:], 1.0, atol=1e-6)
    assert np.linalg.matrix_rank(F) == 2 and K.shape == (3, 3) and len(poses) == 2


def test_points_decide_between_equal_surroundings():
    """Two parallel segments that look alike: only the points tell which is which."""
    one = Segments.from_ends(np.array([[50.0, 50.0, 150.0, 50.0], [50.0, 70.0, 150.0, 70.0]]))
    two = Segments.from_ends(one.ends[::-1] + np.array([30.0, 5.0, 30.0, 5.0]))
    same = np.repeat(np.eye(1, 72, dtype=np.float32), 2, axis=0)
    assert len(match_wide_baseline(one, two, same, same)) == 0  # a tie is no match
    points = np.array([[60.0, 45.0], [90.0, 43.0], [100.0, 60.0], [70.0, 60.0], [120.0, 77.0], [80.0, 76.0]])
    matches = np.hstack([points, points + np.array([30.0, 5.0])])
    found = match_wide_baseline(one, two, same, same, matches)
    assert sorted(map(tuple, found.pairs.tolist())) == [(0, 1), (1, 0)]
    near = [nearby_points(s, p, np.arange(6)) for s, p in ((one, matches[:, :2]), (two, matches[:, 2:]))]
    by_ids = match_wide_baseline(one, two, same, same, (near[0], near[1]))
    np.testing.assert_array_equal(by_ids.pairs, found.pairs)


def test_nearby_points_against_a_plain_count():
    rng = np.random.default_rng(7)
    segments = Segments.from_ends(rng.uniform(0.0, 300.0, (20, 4)))
    points, ids = rng.uniform(0.0, 300.0, (80, 2)), rng.permutation(1000)[:80]
    near = nearby_points(segments, points, ids, reach=25.0)
    for n in range(20):
        offset = points - segments.ends[n, :2]
        along = offset @ segments.direction[n]
        across = points @ segments.line[n, :2] + segments.line[n, 2]
        inside = (np.abs(across) <= 25.0) & (along >= -12.5) & (along <= segments.length[n] + 12.5)
        row = slice(near.begin[n], near.begin[n + 1])
        assert near.point_id[row].tolist() == sorted(ids[inside].tolist())
        np.testing.assert_allclose(near.distance[row], across[inside][np.argsort(ids[inside])], atol=1e-9)


# ------------------------------------------------------------------------------------------------------------ Flow
@pytest.mark.compiled
def test_flow_on_a_warp():
    images, (one, two) = _warped(MILD, seed=3)
    truth = _true_pairs(MILD, one, two)
    found = match_by_flow(*images, one, two)
    precision, recall = _precision_recall(found, truth)
    assert truth.any(axis=1).sum() > 20
    assert precision > 0.95
    assert recall > 0.8


@pytest.mark.compiled
def test_flow_of_an_image_to_itself_is_the_identity():
    (image, _), (one, _) = _warped(MILD, seed=5)
    found = match_by_flow(image, image, one, one)
    assert (found.pairs[:, 0] == found.pairs[:, 1]).all()
    assert len(found) > 0.9 * len(one)


@pytest.mark.compiled
def test_a_wrong_backward_flow_is_noticed():
    images, (one, two) = _warped(MILD, seed=3)
    forward = dense_flow(*images)
    assert len(match_by_flow(*images, one, two, flows=(forward, forward + 20.0))) == 0


# -------------------------------------------------------------------------------------------------- Bad input
def test_nothing_matches_nothing():
    flat, none = np.zeros((30, 40), dtype=np.uint8), Segments.empty()
    some = Segments.from_ends(np.array([[3.0, 3.0, 30.0, 20.0]]))
    zero = np.zeros((0, 72), dtype=np.float32)
    one = np.zeros((1, 72), dtype=np.float32)
    for (s1, d1), (s2, d2) in [((none, zero), (none, zero)), ((some, one), (none, zero)), ((none, zero), (some, one))]:
        assert len(match_wide_baseline(s1, s2, d1, d2, np.zeros((0, 4)), np.eye(3))) == 0
        assert len(match_by_flow(flat, flat, s1, s2)) == 0
    assert len(match_by_flow(flat[:3, :2], flat[:3, :2], some, some)) <= 1


def test_refusals():
    some, one = Segments.from_ends(np.array([[3.0, 3.0, 30.0, 20.0]])), np.zeros((1, 72), dtype=np.float32)
    flat = np.zeros((30, 40), dtype=np.uint8)
    with pytest.raises(ShapeError, match="descriptors_2"):
        match_wide_baseline(some, some, one, one[:0])
    with pytest.raises(ShapeError, match="point_matches"):
        match_wide_baseline(some, some, one, one, np.zeros((3, 2)))
    with pytest.raises(ShapeError, match="fundamental"):
        match_wide_baseline(some, some, one, one, None, np.eye(4))
    with pytest.raises(InputError, match="not zero"):
        match_wide_baseline(some, some, one, one, None, np.zeros((3, 3)))
    with pytest.raises(ShapeError, match="same size"):
        match_by_flow(flat, flat[1:], some, some)
    with pytest.raises(ShapeError, match="one vector a pixel"):
        match_by_flow(flat, flat, some, some, flows=(np.zeros((3, 3, 2), np.float32),) * 2)
    with pytest.raises(InputError, match="step"):
        match_by_flow(flat, flat, some, some, FlowOptions(step=0.0))
    with pytest.raises(ShapeError, match="point_ids"):
        nearby_points(some, np.zeros((3, 2)), np.arange(2))
    with pytest.raises(ShapeError, match="score"):
        LineMatches(np.zeros((2, 2), dtype=int), np.zeros(3))
    with pytest.raises(InputError, match="integers"):
        LineMatches(np.zeros((2, 2)), np.zeros(2))


# ------------------------------------------------------------------------------------------------------------ Files
def test_matches_from_a_file(tmp_path):
    ends = np.array([[3.0, 3.0, 30.0, 20.0], [5.0, 1.0, 5.0, 28.0]])
    written = ExternalMatches({"a.jpg": ends, "b.jpg": ends}, {("a.jpg", "b.jpg"): LineMatches([[0, 1]], [0.7])})
    write_matches(tmp_path / "m.npz", written)
    found = read_matches(tmp_path / "m.npz")
    np.testing.assert_array_equal(found.match("a.jpg", "b.jpg").pairs, [[0, 1]])
    np.testing.assert_array_equal(found.match("b.jpg", "a.jpg").pairs, [[1, 0]])
    assert found.match("b.jpg", "a.jpg").score.tolist() == [0.7]
    assert len(found.match("a.jpg", "c.jpg")) == 0
    segments = found.segments_of("a.jpg", np.zeros((30, 40), dtype=np.uint8))
    np.testing.assert_array_equal(segments.ends, ends)
    assert len(found.segments_of("c.jpg", np.zeros((30, 40), dtype=np.uint8))) == 0


def test_matches_are_written_whole_or_not_at_all(tmp_path, monkeypatch):
    path, some = tmp_path / "m.npz", ExternalMatches({}, {("a", "b"): LineMatches([[0, 1]], [0.7])})
    write_matches(path, some)
    before = path.read_bytes()
    with pytest.raises(OutputError, match="exists already"):
        write_matches(path, ExternalMatches({}, {}))

    def full(file, **arrays):
        file.write_bytes(b"PK")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OutputError, match="No space left"):
        write_matches(path, some, force=True)
    assert path.read_bytes() == before and [one.name for one in tmp_path.iterdir()] == ["m.npz"]
    monkeypatch.undo()
    write_matches(path, ExternalMatches({}, {}), force=True)
    assert not read_matches(path).matches


@pytest.mark.parametrize(
    "arrays",
    [
        {"matches|a|b": np.zeros((3, 3), dtype=int)},
        {"matches|a|b": np.zeros((3, 2))},
        {"matches|a|b": np.array([[0, -1]])},
        {"matches|a|b": np.array([[0, 5]]), "segments|b": np.zeros((5, 4))},
        {"matches|a|b": np.array([[0, 0]]), "scores|a|b": np.array([np.nan])},
        {"matches|a|b": np.array([[0, 0]]), "scores|a|b": np.array([1.5])},
        {"matches|a|b": np.array([[0, 0]]), "scores|a|b": np.zeros(3)},
        {"matches|a|b": np.array(3)},
        {"segments|a": np.zeros((2, 3))},
        {"segments|a": np.full((2, 4), np.inf)},
        {"segments|a": np.array([["x"] * 4])},
        {"other": np.zeros(3)},
    ],
)
def test_bad_files_are_refused(tmp_path, arrays):
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(FileFormatError, match=r"bad\.npz"):
        read_matches(tmp_path / "bad.npz")


def test_files_that_are_no_archives(tmp_path):
    np.savez(tmp_path / "good.npz", **{"segments|a": np.zeros((200, 4))})
    whole = (tmp_path / "good.npz").read_bytes()
    for k, content in enumerate([b"", b"text", whole[: len(whole) // 2], whole[:-30]]):
        (tmp_path / f"{k}.npz").write_bytes(content)
        with pytest.raises(FileFormatError, match="another kind of file, or incomplete"):
            read_matches(tmp_path / f"{k}.npz")
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0xFF
    (tmp_path / "flipped.npz").write_bytes(bytes(flipped))
    with pytest.raises(FileFormatError, match="is damaged: 'segments"):
        read_matches(tmp_path / "flipped.npz")
    np.savez(tmp_path / "objects.npz", **{"segments|a": np.array([{}], dtype=object)})
    with pytest.raises(FileFormatError, match="only arrays of numbers") as refused:
        read_matches(tmp_path / "objects.npz")
    assert "pickle" not in str(refused.value)  # NumPy's advice is to run what is in the file
    with pytest.raises(FileFormatError, match="does not exist"):
        read_matches(tmp_path / "none.npz")


# ------------------------------------------------------------------------------------------------------- Real images
@pytest.mark.shared
def test_stereo_street(shared_data):
    """Rectified: partners share rows, so the end points' rows tell right from wrong."""
    images = [cv2.imread(str(shared_data / "stereo_kitti06" / f"image_{k}" / "000000.png"), 0) for k in (0, 1)]
    one, two = (LsdDetector().detect(image) for image in images)
    F = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    wide = match_wide_baseline(one, two, describe(images[0], one), describe(images[1], two), None, F)
    for found, least in ((match_by_flow(*images, one, two), 150), (wide, 110)):
        assert len(found) >= least
        disparity = (one.midpoint[found.pairs[:, 0]] - two.midpoint[found.pairs[:, 1]])[:, 0]
        assert (disparity > -3.0).mean() > 0.97
