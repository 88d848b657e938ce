# SPDX-License-Identifier: BSD-3-Clause
"""Lines that meet: found in a world of boxes whose corners are known, held together in an adjustment, kept in files."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import groma
from groma.geometry import quaternion, se3
from groma.io import read_archive, write_archive
from groma.mapping.structure.find import find_structure
from groma.scene import Cameras, LineObservations, Lines, Relations, Scene

NOISE = 0.3


@cache
def boxes(windows=False):
    """Edges of boxes in random places, lines across them that meet nothing; true pairs; the scene seen with noise.

    Windows are squares inside a face, four to five pixels from its edges.
    """
    rng = np.random.default_rng(3)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    pairs = [(a, b) for a in range(8) for b in range(a) if (corners[a] != corners[b]).sum() == 1]
    turns = quaternion.to_matrix(se3.exp(rng.normal(size=(12, 6)))[:, :4])
    places = rng.uniform(-1.5, 1.5, (12, 1, 3)) + 0.25 * corners @ np.swapaxes(turns, 1, 2)
    edges = np.concatenate([place[np.array(pairs)] for place in places])
    loose = rng.uniform(-1.7, 1.7, (60, 1, 3)) + rng.normal(0.0, 0.3, (60, 2, 3))
    middle = places[:, :4].mean(axis=1, keepdims=True)
    inner = (middle + 0.88 * (places[:, :4] - middle))[:, np.array([(0, 1), (1, 3), (3, 2), (2, 0)])]
    ends = np.concatenate([edges, loose, inner.reshape(-1, 2, 3)[: None if windows else 0]])
    gap = np.linalg.norm(ends[:, None, :, None] - ends[None, :, None], axis=-1).min(axis=(2, 3))
    meeting = np.argwhere(np.triu(gap < 1e-9, 1))
    angles = np.linspace(0.0, 2.0 * np.pi, 10, endpoint=False)
    centers = np.column_stack([6 * np.cos(angles), 6 * np.sin(angles), 2.5 * np.cos(2 * angles) + 1.0])
    poses = se3.looking_at(centers, np.zeros(3))
    camera = np.array([900.0, 900.0, 500.0, 400.0])
    image, line = np.repeat(np.arange(10), len(ends)), np.tile(np.arange(len(ends)), 10)
    local = quaternion.rotate(poses[image, None, :4], ends[line]) + poses[image, None, 4:]
    pixel = local[..., :2] / local[..., 2:] * camera[:2] + camera[2:] + rng.normal(0.0, NOISE, (len(image), 2, 2))
    exact = Scene.from_images(
        Cameras(np.array([1]), ("PINHOLE",), camera[None], np.array([1000]), np.array([800])),
        [f"{k}.png" for k in range(10)],
        np.zeros(10, int),
        poses,
        lines=Lines.through(ends),
        line_observations=LineObservations(image, line, pixel.reshape(-1, 4)),
    )
    held = groma.AdjustOptions(refine_poses=False, line_sigma_px=NOISE, loss="none")
    return ends, meeting, groma.adjust(exact, held).scene


def test_lines_that_meet_are_found_and_no_others():
    _, true, scene = boxes()
    found = find_structure(scene).relations.lines_meeting
    assert (found[:, 0] < found[:, 1]).all() and len(np.unique(found, axis=0)) == len(found)
    right = (found[:, None] == true[None]).all(axis=2).any(axis=1)
    assert right.sum() > 0.9 * len(true) and right.mean() > 0.98


def test_inner_edges_of_windows_do_not_meet_the_outer_ones():
    """Their lines cross in the face, but they end before: farther than the ends of other lines from their corners."""
    _, true, scene = boxes(windows=True)
    found = find_structure(scene).relations.lines_meeting
    right = (found[:, None] == true[None]).all(axis=2).any(axis=1)
    assert right.sum() > 0.9 * len(true) and right.mean() > 0.98


def test_lines_that_pass_each_other_do_not_meet():
    """The same with every line moved apart from the others: what is left comes near by chance."""
    _, true, scene = boxes()
    rng = np.random.default_rng(1)
    moved = scene.lines.segments + rng.normal(0.0, 0.08, (scene.num_lines, 1, 3))
    apart = scene.replace(lines=Lines.through(moved))
    poses = apart.cam_from_world[apart.line_observations.image_idx]
    local = quaternion.rotate(poses[:, None, :4], moved[apart.line_observations.line_idx]) + poses[:, None, 4:]
    pixel = local[..., :2] / local[..., 2:] * 900.0 + [500.0, 400.0] + rng.normal(0.0, NOISE, (len(poses), 2, 2))
    seen = apart.line_observations.replace(segment=pixel.reshape(-1, 4))
    found = find_structure(apart.replace(line_observations=seen)).relations.lines_meeting
    assert len(found) < 0.02 * len(true)


def corner_error(scene, ends, meeting):
    """Root mean square distance of lines that meet."""
    plucker = scene.lines.plucker[meeting]
    crossed = np.cross(plucker[:, 0, 3:], plucker[:, 1, 3:])
    side = (plucker[:, 0, :3] * plucker[:, 1, 3:]).sum(1) + (plucker[:, 1, :3] * plucker[:, 0, 3:]).sum(1)
    return np.sqrt(np.mean((side / np.linalg.norm(crossed, axis=1)) ** 2))


def test_held_together_they_meet_and_lie_nearer_to_the_truth():
    ends, true, scene = boxes()
    related = scene.replace(relations=Relations(lines_meeting=true))
    options = groma.AdjustOptions(refine_poses=False, line_sigma_px=NOISE, loss="none", structure_sigma_px=0.02)
    free, held = groma.adjust(related, options), groma.adjust(related, replace(options, meeting_lines=True))
    assert free.scene.lines.plucker == pytest.approx(scene.lines.plucker, abs=1e-3)  # not held unasked
    assert corner_error(held.scene, ends, true) < 0.1 * corner_error(free.scene, ends, true)
    assert held.report.relations["lines_meeting"] == {"held": len(true), "dropped": 0}

    def off(scene):
        """Distances of the true ends from the lines."""
        moment, direction = scene.lines.plucker[:, None, :3], scene.lines.plucker[:, None, 3:]
        return np.sqrt(np.mean((np.cross(ends, direction) - moment)[:144] ** 2))

    assert off(held.scene) < 0.9 * off(free.scene)


def test_files_and_selections_keep_them(tmp_path):
    _, true, scene = boxes()
    related = scene.replace(relations=Relations(lines_meeting=true, lines_meeting_sigma=np.full(len(true), 0.01)))
    write_archive(related, tmp_path / "scene.npz")
    read = read_archive(tmp_path / "scene.npz").relations
    assert (read.lines_meeting == true).all() and (read.lines_meeting_sigma == 0.01).all()
    kept = np.arange(5, scene.num_lines)
    fewer = related.keep(lines=kept).relations.lines_meeting
    assert (fewer == true[(true >= 5).all(axis=1)] - 5).all()
