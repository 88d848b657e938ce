# SPDX-License-Identifier: BSD-3-Clause
"""Covers the intervals that images support of lines: which they are, and what files and comparisons take of them."""

import numpy as np
import pytest

from groma.errors import InputError
from groma.estimators.line_intervals import supported_intervals
from groma.evaluation.lines import evaluate_lines
from groma.features.segments import Segments
from groma.io import read_scene, write_scene
from groma.io.archive import read_archive, write_archive
from groma.io.limap.structures import read_limap
from groma.mapping.lines.intervals import with_supported_intervals
from groma.scene import Cameras, LineIntervals, LineObservations, Lines, Points, Relations, Scene, Similarity
from groma.scene.line_intervals import line_pieces, observed_shares, one_line_per_interval, supported_lengths

FOCAL = 500.0


def found(*seen, pixel=0.002):
    """Intervals of one line from (image, begin, end), with a pixel of so much of its length."""
    image, begin, end = np.array(seen, float).T
    line = np.zeros(len(seen), np.int64)
    share = np.column_stack([begin, end])
    return supported_intervals(line, image.astype(np.int64), share, np.full(len(seen), pixel), 1)[1]


def test_what_two_images_show_is_supported():
    np.testing.assert_allclose(found((0, 0, 1), (1, 0, 1), (2, 0, 0.5)), [[0, 1]])
    np.testing.assert_allclose(
        found((0, 0, 0.3), (1, 0, 0.3), (2, 0, 0.31), (0, 0.6, 1), (1, 0.6, 1), (2, 0.61, 1)), [[0, 0.3], [0.6, 1]]
    )
    # The third image alone shows the middle, and two show that nothing is there.
    several = found((0, 0, 0.3), (1, 0, 0.3), (0, 0.6, 1), (1, 0.6, 1), (2, 0, 1))
    np.testing.assert_allclose(several, [[0, 0.3], [0.6, 1]])
    assert len(found((0, 0, 0.4), (1, 0.6, 1))) == 0


def test_breaks_within_the_noise_of_ends_and_undisputed_gaps_are_bridged():
    broken = [(0, 0, 0.5), (0, 0.508, 1), (1, 0, 0.5), (1, 0.508, 1), (2, 0, 0.5)]  # 4 pixels
    np.testing.assert_allclose(found(*broken), [[0, 1]])
    # Each image sees a part; one shows that the parts are one edge, and none denies it.
    np.testing.assert_allclose(found((0, 0, 0.4), (1, 0, 0.4), (2, 0, 1), (3, 0.6, 1), (4, 0.6, 1)), [[0, 1]])
    np.testing.assert_allclose(found((0, 0, 0.4), (1, 0, 0.4), (3, 0.6, 1), (4, 0.6, 1)), [[0, 0.4], [0.6, 1]])


def test_an_occluder_does_not_break_a_line_and_the_majority_decides_on_gaps():
    # A pole hides another part from every view.
    moving = [row for k in range(8) for row in ((k, 0, 0.1 * k + 0.1), (k, 0.1 * k + 0.2, 1))]
    np.testing.assert_allclose(found(*moving), [[0, 1]])
    gap = [row for k in range(6) for row in ((k, 0, 0.4), (k, 0.6, 1))]
    np.testing.assert_allclose(found(*gap, (7, 0, 1), (8, 0, 1)), [[0, 0.4], [0.6, 1]])  # six deny what two show
    np.testing.assert_allclose(found(*gap[:10], (7, 0, 1), (8, 0, 1)), [[0, 1]])


def test_a_line_ends_where_most_images_end_together():
    together = [(k, 0, 0.5 + 0.001 * k) for k in range(6)]  # within 3 pixels
    np.testing.assert_allclose(found(*together, (6, 0, 1), (7, 0, 1)), [[0, 0.505]])
    np.testing.assert_allclose(found(*together, (6, 0, 1), (7, 0, 1), (8, 0, 1), (9, 0, 1)), [[0, 1]])
    mirrored = [(k, 0.5 - 0.001 * k, 1) for k in range(6)]
    np.testing.assert_allclose(found(*mirrored, (6, 0, 1), (7, 0, 1)), [[0.495, 1]])
    # What stands before it hides another part from every view.
    apart = [(k, 0, 0.3 + 0.1 * k) for k in range(6)]
    np.testing.assert_allclose(found(*apart, (6, 0, 1), (7, 0, 1)), [[0, 1]])


def test_places_seen_for_a_pixel_or_two_are_none():
    chance = [(0, 0, 0.5), (1, 0, 0.5), (2, 0.7, 0.705), (3, 0.69, 0.704), (0, 0.9, 1), (1, 0.9, 1)]
    np.testing.assert_allclose(found(*chance), [[0, 0.5], [0.9, 1]])


def seen_from(center, ends):
    """Segment (4,) of a camera that looks along z."""
    at = ends - center
    return (FOCAL * at[:, :2] / at[:, 2:] + 500.0).ravel()


@pytest.fixture
def gapped():
    """A line of length 10 with a gap from 3 to 6, and one without; four cameras that look at them."""
    ends = np.array([[[0.0, 0, 10], [10, 0, 10]], [[0, 1, 10], [10, 1, 12]]])
    shown = [(0, 0.0, 0.3), (0, 0.6, 1.0), (1, 0.0, 1.0)]
    places = np.arange(4) * [[1.0], [-0.5], [0.2]]
    image, line, segment = [], [], []
    for k, center in enumerate(places.T):
        for number, begin, end in shown:
            image.append(k)
            line.append(number)
            at = ends[number, :1] + np.array([[begin], [end]]) * (ends[number, 1] - ends[number, 0])
            segment.append(seen_from(center, at))
    poses = np.column_stack([np.tile([0.0, 0, 0, 1], (4, 1)), -places.T])
    return Scene.from_images(
        Cameras(ids=[1], models=("PINHOLE",), params=[[FOCAL, FOCAL, 500, 500]], width=[1000], height=[1000]),
        [f"{k}.png" for k in range(4)],
        np.zeros(4, int),
        poses,
        points=Points.at([[1.0, 0, 10], [4, 0, 10], [9, 0, 10]]),
        lines=Lines.through(ends),
        line_observations=LineObservations(image, line, segment),
        relations=Relations(point_on_line=[[0, 0], [1, 0], [2, 0]], point_on_line_sigma=[0.1, 0.2, 0.3]),
    )


def test_intervals_of_a_scene_follow_its_similarity_and_its_lines(gapped):
    scene = with_supported_intervals(gapped)
    pieces, line = line_pieces(scene)
    np.testing.assert_array_equal(line, [0, 0, 1])
    np.testing.assert_allclose(pieces[:2, :, 0], [[0, 3], [6, 10]], atol=1e-9)
    np.testing.assert_array_equal(pieces[2], scene.lines.segments[1])
    np.testing.assert_allclose(supported_lengths(scene), [7, np.hypot(10, 2)])
    moved = scene.transformed(Similarity(2.0, np.eye(3), np.ones(3)))
    np.testing.assert_allclose(line_pieces(moved)[0], 2.0 * pieces + 1.0)
    np.testing.assert_array_equal(line_pieces(scene.keep(lines=[1]))[1], [0])
    np.testing.assert_array_equal(line_pieces(scene.keep(lines=[1, 0]))[1], [0, 1, 1])
    shares = observed_shares(scene)
    np.testing.assert_allclose(shares[:3], [[0, 0.3], [0.6, 1], [0, 1]], atol=1e-9)


def test_ends_that_no_two_images_show_go(gapped):
    longer = gapped.lines.segments + np.array([[[0.0, 0, 0], [0, 0, 0]], [[-5, 0, -1], [5, 0, 1]]])
    scene = with_supported_intervals(gapped.replace(lines=gapped.lines.replace(segments=longer)))
    np.testing.assert_allclose(scene.lines.segments, gapped.lines.segments, atol=1e-9)
    assert len(scene.line_intervals) == 2


@pytest.mark.parametrize("images", [1, 4])
def test_where_an_edge_lies_beside_its_line_nothing_is_supported(gapped, images):
    # From 0.6 on the edge bends away, by 4 pixels at its end. What one image of four shows there is noise.
    first, last = gapped.lines.segments[1]
    bend, away = first + 0.6 * (last - first), last + np.array([0.0, 0.1, 0.0])
    seen, rows = gapped.line_observations, [1] * 4
    centers = gapped.cam_centers_in_world
    straight = [seen_from(center, np.array([first, bend])) for center in centers]
    bent = [seen_from(c, np.array([bend, away if k < images else last])) for k, c in enumerate(centers)]
    more = LineObservations([*range(4), *range(4)], rows * 2, [*straight, *bent])
    kept = seen.take(seen.line_idx == 0)
    columns = {
        name: np.concatenate([getattr(kept, name), getattr(more, name)])
        for name in ("image_idx", "line_idx", "segment")
    }
    scene = with_supported_intervals(gapped.replace(line_observations=LineObservations(**columns)))
    reached = (scene.lines.segments[1] - first) @ (last - first) / ((last - first) @ (last - first))
    np.testing.assert_allclose(reached, [0.0, 1.0 if images == 1 else 0.75], atol=0.06)
    np.testing.assert_allclose(line_pieces(scene)[0][:2, :, 0], [[0, 3], [6, 10]], atol=1e-9)


@pytest.mark.parametrize(
    ("num_bent", "turn", "dark", "reached"),
    [
        (2, 0.3, "same", 0.6),  # two show that the edge bends away, two the line
        (1, 0.3, "same", 1.0),  # outvoted
        (2, 0.005, "same", 1.0),  # goes on straight
        (2, 1.2, "same", 1.0),  # no curve: the outline of what hides the edge
        (2, 0.3, "other", 1.0),  # another edge
        (0, 0.0, "none", 1.0),  # images without segments
    ],
)
def test_a_line_ends_where_as_many_images_show_its_edge_bending_away(gapped, num_bent, turn, dark, reached):
    first, last = gapped.lines.segments[1]
    bend, seen = first + 0.6 * (last - first), gapped.line_observations
    rows, segment, segments = np.flatnonzero(seen.line_idx == 1), seen.segment.copy(), []
    for k, center in enumerate(gapped.cam_centers_in_world):
        found = []
        if k < num_bent:
            segment[rows[k]] = seen_from(center, np.array([first, bend]))
            begin, along = segment[rows[k], 2:], np.diff(segment[rows[k]].reshape(2, 2), axis=0)[0]
            turned = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ along
            following = np.concatenate([begin, begin + 40.0 * turned / np.linalg.norm(turned)])
            found = [following if dark == "same" else np.roll(following, 2)]
        ends = np.concatenate([segment[seen.image_idx == k], found]) if found else segment[seen.image_idx == k]
        ends = ends if dark != "none" else ends[:0]
        segments.append(Segments(ends, np.full(len(ends), 0.3), np.full(len(ends), 20.0)))
    scene = gapped.replace(line_observations=seen.replace(segment=segment))
    ended = with_supported_intervals(scene, segments).lines.segments[1]
    np.testing.assert_allclose(
        (ended - first) @ (last - first) / ((last - first) @ (last - first)), [0.0, reached], atol=0.05
    )
    # The direction of the line does not matter.
    backwards = scene.replace(lines=Lines.through(scene.lines.segments[:, ::-1]))
    again = with_supported_intervals(backwards, segments).lines.segments[1, ::-1]
    np.testing.assert_allclose(again, ended, atol=0.05 * np.linalg.norm(last - first))


def test_scenes_without_lines_have_no_bends(gapped):
    bare, nothing = gapped.keep(lines=[]), [Segments.empty()] * 4
    assert with_supported_intervals(bare, nothing).num_lines == 0


def test_one_line_per_interval(gapped):
    scene = with_supported_intervals(gapped)
    split = one_line_per_interval(scene)
    np.testing.assert_array_equal(split.lines.ids, [1, 3, 2])
    np.testing.assert_array_equal(split.line_observations.line_idx, np.tile([0, 1, 2], 4))
    # The point in the gap goes to the nearest piece.
    np.testing.assert_array_equal(split.relations.point_on_line, [[0, 0], [1, 0], [2, 1]])
    np.testing.assert_array_equal(split.relations.point_on_line_sigma, [0.1, 0.2, 0.3])
    assert one_line_per_interval(split) is split


def test_archives_keep_intervals_and_older_ones_have_none(gapped, tmp_path):
    scene = with_supported_intervals(gapped)
    write_archive(scene, tmp_path / "new.npz")
    again = read_archive(tmp_path / "new.npz").line_intervals
    for name in ("line_idx", "begin", "end"):
        np.testing.assert_array_equal(getattr(again, name), getattr(scene.line_intervals, name))
    write_archive(gapped, tmp_path / "old.npz")
    with np.load(tmp_path / "old.npz") as saved:
        assert not any(name.startswith("line_intervals") for name in saved.files)
    assert len(read_archive(tmp_path / "old.npz").line_intervals) == 0


def test_files_have_one_segment_per_interval(gapped, tmp_path):
    scene = with_supported_intervals(gapped)
    write_scene(scene, tmp_path / "model", format="colmap")
    structures = read_limap(tmp_path / "model")
    assert len(structures.lines.ids) == 3
    np.testing.assert_array_equal(np.diff(structures.lines.start), [4, 4, 4])
    assert read_scene(tmp_path / "model").num_lines == 3
    write_scene(scene, tmp_path / "lines.obj")
    text = (tmp_path / "lines.obj").read_text(encoding="ascii")
    assert text.count("\nl ") == 3
    write_scene(scene, tmp_path / "lines.ply")
    assert b"element edge 3\n" in (tmp_path / "lines.ply").read_bytes()


def test_only_what_is_supported_is_compared(gapped):
    truth = Lines.through([[[0.0, 0, 10], [3, 0, 10]], [[6, 0, 10], [10, 0, 10]], [[0, 1, 10], [10, 1, 12]]])
    scene, reference = with_supported_intervals(gapped), Scene(lines=truth)
    before, after = (evaluate_lines(one, reference, [0.01]) for one in (gapped, scene))
    assert before.precision_length[0.01] < 0.9 and after.precision_length[0.01] == pytest.approx(1.0, abs=0.01)


def test_covers():
    intervals = LineIntervals([1, 1], [0.0, 0.6], [0.4, 1.0])
    line, share = np.array([0, 1, 1, 1, 1, 0]), np.array([0.5, 0.39, 0.5, 0.61, 0.41, 1.5])
    np.testing.assert_array_equal(intervals.covers(line, share), [1, 1, 0, 1, 0, 0])
    np.testing.assert_array_equal(intervals.covers(line, share, 0.05), [1, 1, 0, 1, 1, 0])


def test_refused():
    with pytest.raises(InputError, match=r"row 1 is from 0\.5 to 0\.2"):
        LineIntervals([0, 0], [0.0, 0.5], [0.5, 0.2])
