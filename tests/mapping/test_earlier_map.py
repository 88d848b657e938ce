# SPDX-License-Identifier: BSD-3-Clause
"""Mapping lines again at slightly other poses: what is the same is not searched, what has moved is."""

from dataclasses import replace

import numpy as np
import pytest
from _wireframe import arc, random_lines, wireframe

from groma.errors import InputError
from groma.geometry import quaternion
from groma.mapping.checkpoint_files import LINE_MAP
from groma.mapping.lines.build import map_lines
from groma.mapping.lines.hypotheses.earlier import EarlierMap
from groma.mapping.lines.hypotheses.proposals import Proposer
from groma.mapping.lines.linking.tracks import Tracks
from groma.mapping.lines.views import build_views


@pytest.fixture(scope="module")
def world():
    rng = np.random.default_rng(8)
    return wireframe(arc(7), random_lines(30, rng), rng, sigma=0.1)


@pytest.fixture
def searched(monkeypatch):
    """Images of which segments were searched, as they are."""
    images, propose = [], Proposer.propose

    def noted(self, asked):
        if any(given is None for given in asked.matches):
            images.append(asked.image)
        return propose(self, asked)

    monkeypatch.setattr(Proposer, "propose", noted)
    return images


def turned(scene, image, angle):
    """The scene with one camera turned about its axis, by which its epipolar lines move."""
    poses = scene.cam_from_world.copy()
    turn = np.array([0.0, 0.0, np.sin(0.5 * angle), np.cos(0.5 * angle)])
    poses[image, :4] = quaternion.multiply(turn, poses[image, :4])
    poses[image, 4:] = quaternion.rotate(turn, poses[image, 4:])
    return scene.with_poses(poses)


def same_observations(one, two):
    def key(found):
        return set(zip(found.image_idx.tolist(), found.segment_idx.tolist(), strict=True))

    return len(key(one) & key(two)) / max(len(key(one)), len(key(two)))


def test_the_same_poses_give_the_same_lines_without_a_search(world, searched):
    first = map_lines(world.scene, world.segments)
    assert sorted(searched) == list(range(7)) and first.num_lines >= 25
    searched.clear()
    again = map_lines(world.scene, world.segments, earlier=EarlierMap(world.scene, first))
    assert searched == []
    assert again.num_lines == first.num_lines and same_observations(first, again) == 1.0
    np.testing.assert_array_equal(again.depth_ratios, first.depth_ratios)


def test_images_whose_epipolar_lines_moved_are_searched(world, searched):
    before = turned(world.scene, 0, 0.02)  # by several pixels
    first = map_lines(before, world.segments)
    searched.clear()
    again = map_lines(world.scene, world.segments, earlier=EarlierMap(before, first))
    full = map_lines(world.scene, world.segments)
    assert 0 in searched[: -len(world.segments)]
    assert again.num_lines >= full.num_lines - 1 and same_observations(full, again) > 0.95


def test_a_kept_map_says_as_much(world, tmp_path):
    first = map_lines(world.scene, world.segments)
    LINE_MAP.write(first, tmp_path / "lines.npz")
    kept = LINE_MAP.read(tmp_path / "lines.npz")
    for name in ("supporters", "rejection", "depth_ratios"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(first, name))
        assert getattr(kept, name).dtype == getattr(first, name).dtype


def test_lines_that_nothing_changed_are_not_fitted_again(world):
    views = build_views(world.scene, world.segments, 5.0, 0.1, 2.0)
    line_of = np.concatenate(world.truth)
    none = Tracks.none(views, np.zeros(len(line_of), np.int64))
    moved = world.lines + 1e-3
    zero = np.zeros(len(moved))
    tracks = replace(none, lines=moved, uncertainty=zero, unchecked=zero, stale=zero > 0.0).observed_by(line_of)
    assert tracks.stale.all()
    fitted = tracks.refined()
    assert not fitted.stale.any()
    lost = np.flatnonzero(fitted.line_of == 4)[0]
    fewer = fitted.line_of.copy()
    fewer[lost] = -1
    again = fitted.observed_by(fewer)
    assert np.flatnonzero(again.stale).tolist() == [4]
    after = again.refined()
    changed = (after.lines != fitted.lines).any(axis=(1, 2))
    assert np.flatnonzero(changed).tolist() == [4]
    assert fitted.with_sigma(2.0 * fitted.sigma).stale.all()


def test_an_earlier_map_of_other_segments_is_refused(world):
    first = map_lines(world.scene, world.segments)
    fewer = [world.segments[0].select(np.arange(5)), *world.segments[1:]]
    with pytest.raises(InputError, match="same segments"):
        map_lines(world.scene, fewer, earlier=EarlierMap(world.scene, first))
