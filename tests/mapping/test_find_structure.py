# SPDX-License-Identifier: BSD-3-Clause
"""Structure of scenes: planes, directions and relations against the truth of synthetic scenes; noise; real walls."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from _comparison import equal

from groma.adjustment.assemble import assemble, disassemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.errors import InputError
from groma.geometry import quaternion
from groma.io import read_scene
from groma.mapping.noise.landmarks import line_noise, point_noise
from groma.mapping.structure import rough_planes
from groma.mapping.structure.find import StructureOptions, detect_structure, find_structure, landmark_noise
from groma.scene import Directions, Planes, Relations, RightColumns, Scene
from groma.scene.synthetic.scenes import corridor, holistic
from groma.solver.options import SolverOptions
from groma.solver.solve import solve


@cache
def measured(kind, size):
    """Truth of a synthetic scene, and the scene with landmarks estimated from the noisy images, without structure."""
    truth = (corridor if kind == "corridor" else holistic)(size, seed=0).truth
    plain = truth.replace(planes=Planes(), relations=Relations(), directions=Directions())
    problem = assemble(plain, AssemblyOptions(refine_poses=False)).problem
    return truth, disassemble(plain, solve(problem, SolverOptions(max_iterations=15)).problem)


def point_errors(truth, scene):
    return scene.points.xyz - truth.points.xyz


@pytest.mark.kernels
def test_covariances_fit_the_errors():
    """Whitened errors of points have mean square 3, of the four line coordinates 4."""
    truth, scene = measured("corridor", "tiny")
    points = point_noise(scene)
    assert points.sigma_px == pytest.approx(0.5, rel=0.2)
    error = point_errors(truth, scene)
    seen = np.bincount(scene.point_observations.point_idx, minlength=scene.num_points)
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(points.covariance), error)[seen >= 3]
    # Median of chi-square with 3 degrees of freedom: 2.37. The median is spared by points with little parallax.
    assert np.median(squared) == pytest.approx(2.37, rel=0.35)
    lines = line_noise(scene, 0.5)
    d = truth.lines.plucker[:, 3:]
    foot = np.cross(d, truth.lines.plucker[:, :3])
    ends = scene.lines.segments
    on_truth = foot[:, None] + np.einsum("lei,li->le", ends, d)[..., None] * d[:, None]
    moves = np.einsum("lai,lei->lea", lines.across, ends - on_truth).reshape(-1, 4)
    squared = np.einsum("ni,nij,nj->n", moves, np.linalg.inv(lines.covariance), moves)
    assert np.median(squared) == pytest.approx(3.36, rel=0.35)


def test_columns_in_right_images_are_observations():
    """Information is additive: that of a column is the outer product of its derivative, here by differences."""
    _, scene = measured("corridor", "tiny")
    table = scene.point_observations
    rows = np.arange(0, len(table), 3)
    baseline, sigma = 0.2, 0.7
    poses, params = scene.cam_from_world[table.image_idx[rows]], scene.cameras.params[0]

    def columns(xyz):
        in_cam = quaternion.rotate(poses[:, :4], xyz[table.point_idx[rows]]) + poses[:, 4:]
        return params[0] * (in_cam[:, 0] - baseline) / in_cam[:, 2] + params[-2]

    xyz, step = scene.points.xyz, 1e-6
    by_world = np.stack([(columns(xyz + d) - columns(xyz - d)) / (2 * step) for d in step * np.eye(3)], axis=1)
    added = np.zeros((scene.num_points, 3, 3))
    np.add.at(added, table.point_idx[rows], by_world[:, :, None] * by_world[:, None, :] / sigma**2)
    full = np.full(len(rows), baseline), np.full(len(rows), sigma)
    pairs = scene.replace(right_columns=RightColumns(rows, columns(xyz), *full))
    without, with_columns = (np.linalg.inv(point_noise(s, 1.0).covariance) for s in (scene, pairs))
    assert np.abs(added).max() > 1.0
    np.testing.assert_allclose(with_columns - without, added, rtol=1e-4, atol=1e-4 * np.abs(added).max())
    # A column that is off is a misfit.
    off = pairs.replace(right_columns=RightColumns(rows, columns(xyz) + 5.0, *full))
    assert (point_noise(off, 1.0).misfit[table.point_idx[rows]] > 1.5).all()


def test_corridor_has_its_walls_and_directions():
    truth, scene = measured("corridor", "small")
    structure = detect_structure(scene)
    found, true = structure.scene.planes.hesse, truth.planes.hesse
    assert structure.point_sigma_px == pytest.approx(0.5, rel=0.1)
    cosine = found[:, :3] @ true[:, :3].T
    same = (np.abs(cosine) > np.cos(0.01)) & (np.abs(found[:, 3:] - np.sign(cosine) * true[:, 3]) < 0.05)
    assert same.any(axis=1).all()  # no plane that is not there
    assert same.any(axis=0).all()  # none is missing
    relations = structure.scene.relations
    for name, places in (("point_on_plane", truth.points.xyz[:, None]), ("line_on_plane", truth.lines.segments)):
        landmark, plane = getattr(relations, name).T
        nearest = true[same.argmax(axis=1)[plane]]
        height = np.abs(np.einsum("nei,ni->ne", places[landmark], nearest[:, :3]) + nearest[:, 3:]).max(axis=1)
        # What is counted wrong lies on another wall, within noise of the corner.
        assert (height < 1e-6).mean() > 0.98
        assert (height < 0.1).all()  # lines that few images see are that uncertain
        assert len(np.unique(landmark)) > 0.75 * len(places)
    assert structure.scene.num_directions == 3
    assert structure.directions.orthogonal.tolist() == [[0, 1], [0, 2], [1, 2]]
    line, direction = relations.line_along_direction.T
    angle = np.cross(truth.lines.plucker[line, 3:], structure.scene.directions.vectors[direction])
    assert np.linalg.norm(angle, axis=1).max() < 5e-3
    assert len(line) > 0.8 * scene.num_lines
    # No point of this scene lies on a line, though hundreds are near one on the wall.
    assert len(relations.point_on_line) < 0.02 * scene.num_lines
    for name, values in structure.probability.items():
        assert len(values) == len(getattr(relations, name))


def test_progress_and_what_is_left_out():
    """Every stage is said and goes forward; each direction that is kept is shared by lines."""
    _, scene = measured("corridor", "tiny")
    said: list[tuple[str, int, int]] = []
    found = find_structure(scene, progress=lambda *event: said.append(event))
    assert list(dict.fromkeys(stage for stage, _, _ in said)) == [
        "finding planes",
        "finding directions",
        "finding relations",
    ]
    settled = [done for stage, done, total in said if stage == "finding planes" and total > 1]
    assert len(settled) >= found.num_planes and settled == sorted(settled)
    assert all(0 <= done <= total for _, done, total in said)
    lines = np.bincount(found.relations.line_along_direction[:, 1], minlength=found.num_directions)
    assert (lines >= 2).all()
    # With a gate that no line passes, directions have nothing on them and are not kept.
    strict = detect_structure(scene, StructureOptions(level=1e-9))
    assert strict.scene.num_directions == len(strict.directions)
    lines = np.bincount(strict.scene.relations.line_along_direction[:, 1], minlength=strict.scene.num_directions)
    assert (lines >= 2).all()
    assert strict.scene.num_directions < found.num_directions
    assert len(strict.probability["line_along_direction"]) == len(strict.scene.relations.line_along_direction)


def test_lines_take_part_with_the_noise_that_they_show():
    """With residuals four times the usual ones they are known a quarter as well, and still lie on their walls."""
    _, scene = measured("corridor", "tiny")
    points, lines = landmark_noise(scene, StructureOptions())
    usual, shown = (find_structure(scene, noise=(points, replace(lines, misfit=one * lines.misfit))) for one in (1, 4))
    assert len(shown.relations.line_on_plane) > 0.8 * len(usual.relations.line_on_plane) > 0


def test_points_on_lines():
    truth, scene = measured("holistic", 50)
    found = {tuple(pair) for pair in find_structure(scene).relations.point_on_line}
    true = {tuple(pair) for pair in truth.relations.point_on_line}
    assert len(found & true) > 0.85 * len(true)
    assert len(found & true) > 0.97 * len(found)
    without = find_structure(scene, StructureOptions(points_on_lines=False))
    assert len(without.relations.point_on_line) == 0


def test_wrong_planes_are_not_invented():
    """Planes with ten points each among hundreds are hard to tell from chance; what is reported is right."""
    truth, scene = measured("holistic", 50)
    found = find_structure(scene).planes.hesse
    for plane in found:
        gap = np.minimum(np.abs(truth.planes.hesse - plane).max(axis=1), np.abs(truth.planes.hesse + plane).max(axis=1))
        assert gap.min() < 0.02


@pytest.mark.kernels
def test_other_tables_stay_and_order_is_no_matter():
    _, scene = measured("corridor", "tiny")
    one, two = find_structure(scene), find_structure(find_structure(scene))
    assert equal(one, two)
    assert equal(one.replace(planes=Planes(), relations=Relations(), directions=Directions()), scene)


def test_scene_without_landmarks():
    empty = find_structure(Scene())
    assert empty.num_planes == 0 and empty.num_directions == 0 and len(empty.relations) == 0
    _, scene = measured("corridor", "tiny")
    points = find_structure(scene.points_only())
    assert points.num_directions == 0 and len(points.relations.line_on_plane) == 0


def test_bad_options():
    with pytest.raises(InputError, match="level"):
        find_structure(Scene(), StructureOptions(level=2.0))
    with pytest.raises(InputError, match="min_line_probability"):
        find_structure(Scene(), StructureOptions(min_line_probability=1.0))
    with pytest.raises(InputError, match="min_direction_probability"):
        find_structure(Scene(), StructureOptions(min_direction_probability=-0.1))


@pytest.mark.shared
def test_facade_of_real_church(shared_data):
    scene = read_scene(shared_data / "strecha_herz_jesus_p8" / "sparse_gt")
    structure = detect_structure(scene)
    assert 2 <= len(structure.planes) <= 30  # the front has many parallel layers: walls, jambs, steps
    assert structure.planes.support[0] > 1000
    # The church has one front; its parallel layers agree in direction.
    cosine = np.abs(structure.planes.planes[:, :3] @ structure.planes.planes[0, :3])
    assert (cosine > np.cos(0.05))[:3].all()


def test_a_plane_that_was_lost_among_the_pieces_of_another_is_found_again(monkeypatch):
    """As if the first plane were a piece of the second: what it was found in is free again."""
    _, scene = measured("corridor", "tiny")
    usual, joined, calls = find_structure(scene), rough_planes._joined, []

    def losing(marks, planes, *args, **kwargs):
        calls.append(len(planes))
        if len(calls) > 1:
            return joined(marks, planes, *args, **kwargs)
        into = np.maximum(np.arange(len(planes)) - 1, 0)
        return into, planes.take(np.arange(1, len(planes)), into)

    monkeypatch.setattr(rough_planes, "_joined", losing)
    again = find_structure(scene)
    assert calls == [usual.num_planes] * 2 and again.num_planes == usual.num_planes > 1
    normals = usual.planes.hesse[:, :3]
    np.testing.assert_allclose(np.abs(normals @ again.planes.hesse[:, :3].T).max(axis=1), 1.0, atol=1e-4)
