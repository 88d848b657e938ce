# SPDX-License-Identifier: BSD-3-Clause
"""Lines that are one although mapped twice, lines that are two although they are near, and where lines end."""

import numpy as np
import pytest
from _wireframe import Wireframe, arc, random_lines, true_lines, wireframe

from groma.adjustment.rescue.restart import with_seen_ends
from groma.features.segments import Segments
from groma.geometry import quaternion
from groma.mapping.lines.build import map_lines
from groma.mapping.lines.intervals import with_supported_intervals
from groma.mapping.lines.line_map import LineMap
from groma.mapping.lines.options import MapLinesOptions
from groma.mapping.lines.outcomes import Outcome


def flipped(world: Wireframe, images: range) -> list[Segments]:
    """The world's segments, those of some images run the other way."""
    turned = list(world.segments)
    for i in images:
        turned[i] = Segments.from_ends(world.segments[i].ends[:, [2, 3, 0, 1]], 0.2)
    return turned


def test_an_edge_whose_darker_side_changes_is_one_line():
    rng = np.random.default_rng(21)
    world = wireframe(arc(12), random_lines(12, rng), rng)
    found = map_lines(world.scene, flipped(world, range(6, 12)))
    true = true_lines(world, found)
    assert (true >= 0).all()
    assert len(np.unique(true)) == len(true) >= 10
    assert np.median(found.num_images) > 8


def test_an_edge_that_bent_poses_show_twice_is_one_line():
    rng = np.random.default_rng(24)
    world = wireframe(arc(12), random_lines(12, rng), rng)
    poses = world.scene.cam_from_world
    poses[6:, 5] += 0.03  # five pixels
    found = map_lines(world.scene.with_poses(poses), flipped(world, range(6, 12)))
    true = true_lines(world, found)
    assert (true >= 0).all()
    repeated = len(true) - len(np.unique(true))
    assert len(np.unique(true)) >= 9
    assert repeated <= 3


def test_two_edges_of_a_bar_stay_two_lines():
    rng = np.random.default_rng(22)
    lines = random_lines(8, rng)
    across = np.cross(lines[:, 1] - lines[:, 0], [0.0, 1.0, 0.0])
    across *= 0.025 / np.linalg.norm(across, axis=1, keepdims=True)  # four pixels
    world = wireframe(arc(10), np.concatenate([lines, lines + across[:, None]]), rng)
    found = map_lines(world.scene, world.segments)
    true = true_lines(world, found)
    assert np.isin(np.arange(16), true).sum() >= 14
    assert (true >= 0).mean() > 0.9


def shown_whole(world: Wireframe, rng: np.random.Generator, along: float, run_on: np.ndarray) -> list[Segments]:
    """All images see the whole lines, with errors along them, and the second end ``run_on`` (C,) pixels further out."""
    segments = []
    for pose, further in zip(world.scene.cam_from_world, run_on, strict=True):
        local = world.lines @ quaternion.to_matrix(pose[None, :4])[0].T + pose[4:]
        pixel = (700.0 * local[..., :2] / local[..., 2:] + [400.0, 300.0]).reshape(-1, 4)
        unit = pixel[:, 2:] - pixel[:, :2]
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        error = rng.normal([0.0, further], along, (len(pixel), 2))
        segments.append(Segments.from_ends(pixel + error.repeat(2, 1) * np.hstack([unit, unit]), 0.05))
    return segments


def pixels_beyond(world: Wireframe, found: LineMap) -> np.ndarray:
    """(L, 2) how far both ends of mapped lines lie beyond those of the true lines, about, in pixels."""
    nearest = np.linalg.norm(found.segments.mean(1)[:, None] - world.lines.mean(1), axis=-1).argmin(1)
    true = world.lines[nearest]
    unit = (true[:, 1] - true[:, 0]) / np.linalg.norm(true[:, 1] - true[:, 0], axis=1, keepdims=True)
    at = np.sort(((found.segments - true.mean(1)[:, None]) * unit[:, None]).sum(-1), axis=1)
    half = 0.5 * np.linalg.norm(true[:, 1] - true[:, 0], axis=1)
    return np.column_stack([-at[:, 0] - half, at[:, 1] - half]) * 700.0 / 4.0


def test_ends_are_where_most_images_see_them():
    rng = np.random.default_rng(23)
    world = wireframe(arc(12), random_lines(12, rng), rng)
    found = map_lines(world.scene, shown_whole(world, rng, 1.0, np.zeros(12)))
    assert found.num_lines >= 10
    assert abs(np.median(pixels_beyond(world, found))) < 0.8  # pixels; the outermost but one of twelve lies 1.1 out


@pytest.mark.parametrize("number", [2, 6])
def test_few_images_that_run_on_do_not_make_a_line_longer(number):
    rng = np.random.default_rng(25)
    world = wireframe(arc(12), random_lines(12, rng), rng)
    run_on = np.zeros(12)
    run_on[3 : 3 + number] = 40.0
    found = map_lines(world.scene, shown_whole(world, rng, 0.5, run_on))
    assert found.num_lines >= 10
    first, second = np.median(pixels_beyond(world, found), axis=0)
    assert abs(first) < 1.5
    assert abs(second - (0.0 if number == 2 else 40.0)) < (1.5 if number == 2 else 8.0)  # foreshortened in places


@pytest.mark.parametrize(("apart", "stays"), [(0.95, False), (5.0, True)])
def test_a_line_that_repeats_another_beside_it_is_dropped(apart, stays):
    rng = np.random.default_rng(26)
    lines = random_lines(12, rng)
    world = wireframe(arc(14), lines, rng, sigma=0.03)
    # Four images show two of the lines beside where they are, and nothing there.
    segments = list(world.segments)
    for i in range(4):
        ends = segments[i].ends.copy()
        for k in np.flatnonzero((world.truth[i] == 0) | (world.truth[i] == 1)):
            unit = ends[k, 2:] - ends[k, :2]
            unit /= np.linalg.norm(unit)
            ends[k] += np.tile(apart * np.array([-unit[1], unit[0]]), 2)
        segments[i] = Segments.from_ends(ends, 0.05)
    found = map_lines(world.scene, segments)
    repeated = len(found.lines) - len(np.unique(true_lines(world, found)))
    assert repeated == (2 if stays else 0)
    assert (found.outcome_counts()[Outcome.REPEATED] == 0) == stays


def seen_in_pieces(world: Wireframe, rng: np.random.Generator) -> list[Segments]:
    """The world's segments, of which most images show a third only, anywhere along the line."""
    segments = []
    for i, whole in enumerate(world.segments):
        first = rng.uniform(0.0, 0.66, len(whole)) if i % 4 else np.zeros(len(whole))
        share = np.column_stack([first, first + (0.34 if i % 4 else 1.0)])
        along = whole.ends[:, 2:] - whole.ends[:, :2]
        ends = [whole.ends[:, :2] + share[:, k : k + 1] * along for k in (0, 1)]
        segments.append(Segments.from_ends(np.hstack(ends), 0.2))
    return segments


@pytest.mark.kernels
def test_a_line_that_most_images_see_in_pieces_keeps_its_length():
    rng = np.random.default_rng(27)
    world = wireframe(arc(12), random_lines(12, rng), rng)
    segments = seen_in_pieces(world, rng)
    found = map_lines(world.scene, segments, options=MapLinesOptions(min_length=5.0))
    assert found.num_lines >= 10
    lined = found.add_to(world.scene, segments)
    # As mapped lines are: what most images end together is cut from them.
    ended = with_supported_intervals(with_seen_ends(lined, np.arange(found.num_lines)))
    before, after = (np.linalg.norm(np.diff(scene.lines.segments, axis=1)[:, 0], axis=1) for scene in (lined, ended))
    np.testing.assert_allclose(after, before, rtol=0.02)
    nearest = np.linalg.norm(found.segments.mean(1)[:, None] - world.lines.mean(1), axis=-1).argmin(1)
    true = np.linalg.norm(world.lines[nearest, 1] - world.lines[nearest, 0], axis=1)
    assert np.median(after / true) > 0.75  # the segments before they are cut are 0.85 of it
