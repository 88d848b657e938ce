# SPDX-License-Identifier: BSD-3-Clause
"""How well measurements are checked, and which are wrong: against dense computations and adjustments without them."""

from dataclasses import replace

import numpy as np
import pytest
from _survey import SIGMA, control, distances, made, positions, with_everything, with_objects

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.survey.reliability import noncentrality, reliability
from groma.problem.residuals import jacobians_of, residuals_of
from groma.scene import Similarity

LEAST_SQUARES = AdjustOptions(loss="none", point_sigma_px=0.5, check_lens=False)
UTM = np.array([4e5, 5.4e6, 200.0])


@pytest.fixture(scope="module")
def truth_and_start():
    return made()


def dense(problem):
    """Whitened Jacobian of all factors and residuals, by plain NumPy; and the rows of each factor."""
    starts, size = {}, 0
    for name, group in problem.variables.items():
        if not group.is_constant:
            starts[name] = size
            size += len(group) * group.manifold.dof
    rows, residuals, where = [], [], []
    for factor in problem.factors:
        blocks, residual = jacobians_of(factor, problem.variables), residuals_of(factor, problem.variables)
        J = np.zeros((len(factor), residual.shape[1], size))
        for slot, ref in factor.references():
            if ref.group in starts:
                dof = problem.variables[ref.group].manifold.dof
                for i, k in enumerate(ref.index):
                    J[i, :, starts[ref.group] + k * dof :][:, :dof] += blocks[slot.name][i]
        root = np.asarray(factor.sqrt_information, float)
        root = root if root.ndim == 3 else np.broadcast_to(root, len(factor))[:, None, None] * np.eye(residual.shape[1])
        where.append(slice(sum(map(len, rows)), sum(map(len, rows)) + residual.size))
        rows.append((root @ J).reshape(-1, size))
        residuals.append(np.einsum("nij,nj->ni", root, residual).reshape(-1))
    return np.concatenate(rows), np.concatenate(residuals), where


def small(rng, seed=1, alone=False):
    """A small scene with every kind of measurement, by least squares; control points have one mark if alone."""
    truth, _ = made(6, seed=seed)
    truth = truth.keep(points=np.arange(truth.num_points) < 60)
    scene = with_objects(with_everything(truth, rng), rng)
    if alone:
        kept = ~scene.control_points.is_control[scene.marks.point_idx]
        kept[np.unique(scene.marks.point_idx, return_index=True)[1]] = True
        scene = scene.replace(marks=scene.marks.take(np.flatnonzero(kept)))
    result = adjust(scene, replace(LEAST_SQUARES, function_tolerance=1e-12))
    return truth, result


@pytest.mark.parametrize("alone", [False, True])
def test_redundancy_numbers_and_tests_are_those_of_the_dense_adjustment(alone):
    _, result = small(np.random.default_rng(0), alone=alone)
    found = reliability(result.scene, result.problem)
    A, b, where = dense(result.problem)
    hat = A @ np.linalg.solve(A.T @ A, A.T)
    leave = 1 - np.diag(hat)
    assert leave.sum() == pytest.approx(A.shape[0] - A.shape[1])
    types = [factor.type_name for factor in result.problem.factors]
    rows = iter(found.measurements)
    for name, part in zip(types, where, strict=True):
        if name == "point_reprojection" and part.start == 0:
            continue  # the points of the scene
        for k in range(part.start, part.stop):
            one = next(rows)
            assert one.redundancy == pytest.approx(leave[k], abs=1e-6), (one.kind, one.name)
            assert one.weight == pytest.approx(1.0)
            assert one.normalized == pytest.approx(-b[k] / np.sqrt(leave[k]), abs=1e-4)
            assert one.detectable == pytest.approx(noncentrality() * one.sigma / np.sqrt(leave[k]), rel=1e-4)
    assert next(rows, None) is None
    kinds = [one.kind for one in found.measurements]
    known = {"known plane", "known direction", "camera pose"}
    assert set(kinds) == {"camera position", "control point", "mark", "distance"} | known
    for kind in set(kinds):
        of_kind = sum(one.redundancy for one in found.measurements if one.kind == kind and not one.is_suspect)
        assert found.redundancy[kind] == pytest.approx(of_kind, rel=0.05)


def test_a_doubted_measurement_is_tested_as_if_it_had_taken_no_part():
    """The robust loss lowers its weight; the test is that of the adjustment without it."""
    truth, _ = made(6)
    truth = truth.keep(points=np.arange(truth.num_points) < 60)
    scene = truth.replace(camera_positions=positions(truth, np.random.default_rng(0)))
    xyz = scene.camera_positions.xyz.copy()
    xyz[2] += [0.4, 0.0, 0.0]
    scene = scene.replace(camera_positions=scene.camera_positions.replace(xyz=xyz))
    exact = replace(LEAST_SQUARES, function_tolerance=1e-13)
    result = adjust(scene, exact)
    found = [one for one in reliability(result.scene, result.problem).measurements if one.name == "00003.png"]
    assert found[0].weight < 0.3 and found[0].is_suspect
    assert reliability(result.scene, result.problem).suspects[0].name == "00003.png"
    without = adjust(scene.replace(camera_positions=scene.camera_positions.take(np.arange(6) != 2)), exact)
    spread = without.uncertainty().centers[2] + scene.camera_positions.covariance[2]
    away = xyz[2] - without.scene.cam_centers_in_world[2]
    P = np.linalg.inv(scene.camera_positions.covariance[2])
    score = (
        P
        @ np.linalg.inv(P + np.linalg.inv(without.uncertainty().centers[2]))
        @ np.linalg.inv(without.uncertainty().centers[2])
        @ away
    )
    full = np.linalg.inv(spread)
    np.testing.assert_allclose(score, full @ away, rtol=1e-6)  # the same by two ways
    normalized = (full @ away) / np.sqrt(np.diag(full))
    np.testing.assert_allclose([one.normalized for one in found], normalized, rtol=0.02, atol=0.05)


def test_predicted_errors_are_those_that_occur():
    """The squared errors of all cameras in units of their covariance, over draws of all noise: 3 a camera."""
    truth, _ = made(6)
    truth = truth.keep(points=np.arange(truth.num_points) < 60)
    exact = truth.point_observations.pixel - pixel_noise(truth)
    squares, checks = [], []
    for draw in range(12):
        rng = np.random.default_rng(100 + draw)
        pixel = exact + rng.normal(size=exact.shape) * 0.5
        drawn = truth.replace(point_observations=truth.point_observations.replace(pixel=pixel))
        scene = with_objects(with_everything(drawn, rng), rng)
        result = adjust(scene, LEAST_SQUARES)
        off = result.scene.cam_centers_in_world - truth.cam_centers_in_world
        squares.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(result.uncertainty().centers), off).mean())
        checks += [one.normalized_square for one in reliability(result.scene, result.problem).check_points]
    # the errors of the cameras of a draw depend on each other: 12 x 6 to 36 independent draws of chi-square 3
    assert 2.2 < np.mean(squares) < 3.9
    assert len(checks) == 24 and 1.8 < np.mean(checks) < 4.4


@pytest.mark.parametrize("sigma", [1.0, 1e5])
def test_measurements_that_weigh_little_place_the_scene_all_the_same(sigma):
    """Positions so weak that beside the pixels they are lost in rounding: the scene ends where they fit best."""
    truth, _ = made(8)
    rng = np.random.default_rng(0)
    scene = truth.transformed(Similarity(1e-3)) if sigma > 1 else truth
    table = positions(scene, rng, sigma * (1e-3 if sigma < 1e3 else 1e-6))
    table = table.replace(covariance=table.covariance * 1e6)
    twist = Similarity.from_array(np.array([0.05, 0.1, -0.02, np.sqrt(1 - 0.0129), 0.3, -0.2, 0.1, 1.1]))
    start = scene.transformed(twist).replace(camera_positions=table)
    result = adjust(start, LEAST_SQUARES)

    def cost(moved):
        off = moved.cam_centers_in_world - table.xyz
        return np.einsum("ni,nij,nj->", off, np.linalg.inv(table.covariance), off)

    best = cost(result.scene)
    size = np.sqrt(table.covariance[0, 0, 0]) * 1e-2
    for k in range(3):
        for sign in (-1, 1):
            assert cost(result.scene.transformed(Similarity(translation=sign * size * np.eye(3)[k]))) >= best
            turn = np.zeros(8)
            turn[[3, 7]], turn[k] = 1.0, sign * 1e-5
            turn[:4] /= np.linalg.norm(turn[:4])
            assert cost(result.scene.transformed(turn)) >= best - 1e-9
    found = reliability(result.scene, result.problem)
    if sigma > 1:
        assert found.redundancy["camera position"] == pytest.approx(3 * 8 - 7, abs=0.01)
    # the noise was a thousandth of what was stated; the photographs add theirs
    assert 0.3 < found.components["camera position"] * 1e3 < 5.0


def pixel_noise(truth):
    from groma.scene.synthetic.noise import project_pinhole

    table = truth.point_observations
    poses = truth.cam_from_world[table.image_idx]
    return table.pixel - project_pinhole(truth.cameras.params[0], poses, truth.points.xyz[table.point_idx])[0]


def test_nothing_checks_the_only_scale_bar(truth_and_start):
    truth, _ = truth_and_start
    points, marks, xyz = control(truth, np.random.default_rng(1))
    between = distances(truth, xyz, np.random.default_rng(1)).take([0])
    scene = truth.replace(control_points=points.replace(role=np.zeros(6, int)), marks=marks, distances=between)
    result = adjust(scene, LEAST_SQUARES)
    bar = reliability(result.scene, result.problem).measurements[-1]
    assert bar.kind == "distance" and bar.redundancy < 1e-4
    assert abs(bar.residual) < 1e-4 * SIGMA
    assert reliability(truth) is None
