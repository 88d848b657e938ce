# SPDX-License-Identifier: BSD-3-Clause
"""The compiled fit of one pose: the same equations and minima as the factors that every adjustment is made of."""

import numpy as np
import pytest

from groma.adjustment.assemble import assemble
from groma.adjustment.pose_fit import equations_at, fit_pose, line_rows, plane_rows, point_rows, seen_map, without_prior
from groma.adjustment.stages import with_loss
from groma.factors.losses import Cauchy, GemanMcClure, Trivial
from groma.geometry import se3
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.scene import Lines, PosePriors
from groma.solver.options import SolverOptions
from groma.solver.solve import solve
from groma.tracking.frame.camera import TrackCamera, into, planes_into
from groma.tracking.frame.measurements import LineMeasurements, PlaneMeasurements, PointMeasurements
from groma.tracking.map.landmarks import ALIVE, LineTable, PlaneTable, PointTable
from groma.tracking.map.map_scene import TRACKING, Seen, map_scene
from groma.tracking.map.track_map import TrackMap

pytestmark = pytest.mark.kernels

CAMERA = TrackCamera(500.0, 510.0, 320.0, 240.0, 640, 480, baseline=0.3)
TRUE = se3.exp(np.array([[0.1, -0.05, 0.02, 0.05, -0.03, 0.04]]))[0]
START = se3.compose(se3.exp(np.array([[0.03, 0.02, -0.02, 0.02, 0.01, -0.02]])), TRUE[None])[0]
PRIOR = se3.compose(se3.exp(np.array([[-0.02, 0.01, 0.03, 0.01, -0.02, 0.01]])), TRUE[None])[0]
SIGMA = np.array([0.1, 0.12, 0.14, 0.05, 0.06, 0.07])


def _map(rng, wrong=6):
    """A map, and what a frame measures of it: depths, columns on the right, inverse depths of some; some are wrong."""
    points, lines, planes = PointTable(), LineTable(), PlaneTable()
    for table, count in ((points, 40), (lines, 12), (planes, 3)):
        table.extend(count)
        table.state[:] = ALIVE
    points.xyz[:] = CAMERA.bearings(rng.uniform((20, 20), (620, 460), (40, 2))) * rng.uniform(1.5, 4.0, (40, 1))
    ends = np.stack([CAMERA.bearings(rng.uniform((20, 20), (620, 460), (12, 2))) for _ in (0, 1)], axis=1)
    lines.segment[:] = ends * rng.uniform(1.5, 4.0, (12, 2, 1))
    lines.plucker[:] = Lines.through(lines.segment).plucker
    normals = rng.normal(size=(3, 3))
    planes.hesse[:] = np.hstack([normals / np.linalg.norm(normals, axis=1)[:, None], rng.uniform(1, 3, (3, 1))])
    in_cam = into(TRUE, points.xyz)
    pixel = CAMERA.project(in_cam) + 0.5 * rng.normal(size=(40, 2))
    pixel[:wrong] += rng.uniform(10.0, 40.0, (wrong, 2))
    right = pixel - np.column_stack([CAMERA.fx * CAMERA.baseline / in_cam[:, 2], np.zeros(40)])
    depth, known = in_cam[:, 2] + 0.01 * rng.normal(size=40), rng.random((2, 40)) < 0.5
    seen_points = PointMeasurements(
        np.arange(40), pixel, rng.uniform(0.4, 0.8, 40), np.where(known[0], depth, np.nan), np.full(40, 0.02),
        np.where(known[1, :, None], right, np.nan),
    )  # fmt: skip
    in_cam = into(TRUE, lines.segment)
    ends = np.hstack([CAMERA.project(in_cam[:, 0]), CAMERA.project(in_cam[:, 1])]) + 0.3 * rng.normal(size=(12, 4))
    inverse = np.where(rng.random((12, 1)) < 0.6, 1.0 / in_cam[..., 2], np.nan)
    seen_lines = LineMeasurements(np.arange(12), ends, rng.uniform(0.3, 0.6, 12), inverse, np.full((12, 2), 0.01))
    root = rng.normal(size=(3, 3, 3)) + 50.0 * np.eye(3)
    flipped = planes_into(TRUE, planes.hesse) * np.array([1.0, -1.0, 1.0])[:, None]
    seen_planes = PlaneMeasurements(np.arange(3), flipped, root)
    return TrackMap(points, lines, planes), seen_points, seen_lines, seen_planes


def _both(rng):
    """The same map and measurements as tables of the fit, and as a problem of factors."""
    view, points, lines, planes = _map(rng)
    K = CAMERA.params
    seen = seen_map(
        K,
        (CAMERA.baseline, CAMERA.line_baseline),
        point_rows(view.points.xyz, points.pixel, points.sigma, points.right[:, 0], points.depth, points.depth_sigma),
        line_rows(view.lines.plucker, lines.ends, lines.sigma, lines.inverse_depth, lines.inverse_depth_sigma, K,
                  CAMERA.line_baseline),
        plane_rows(view.planes.hesse, planes.plane, planes.sqrt_information),
        PRIOR,
        SIGMA,
    )  # fmt: skip
    image = [np.zeros(len(table), np.int64) for table in (points, lines, planes)]
    scene = map_scene(
        CAMERA, view, START[None], ["frame"], Seen(points.index, points, image[0]),
        Seen(lines.index, lines, image[1]), Seen(planes.index, planes, image[2]),
        pose_priors=PosePriors(np.zeros(1, np.int64), PRIOR[None], SIGMA[None]),
    )  # fmt: skip
    options = {**vars(TRACKING), "refine_landmarks": False}
    return seen, assemble(scene, type(TRACKING)(**options)).problem


def _summed(problem, with_prior=True):
    """Cost, H and g of a problem with one pose, by the records of its factors."""
    cost, H, g = 0.0, np.zeros((6, 6)), np.zeros(6)
    for factor in problem.factors:
        if factor.type_name == "pose_prior" and not with_prior:
            continue
        ambients = tuple(problem.variables[ref.group].ambient() for _, ref in factor.references())
        columns = tuple(0 if slot.name == "pose" else -1 for slot, _ in factor.references())
        record = np.zeros((len(factor), factor.residual_size, 7))
        factor.linearize(factor.prepare(ambients), 0, len(factor), columns, record)
        root = np.asarray(factor.sqrt_information)
        record = root @ record if root.ndim == 3 else record * root.reshape(-1, 1, 1)
        rho, weight, _ = factor.loss.evaluate((record[..., 6] ** 2).sum(axis=1))
        J, r = record[..., :6], record[..., 6]
        cost += 0.5 * rho.sum()
        H += np.einsum("n,nki,nkj->ij", weight, J, J)
        g += np.einsum("n,nki,nk->i", weight, J, r)
    return cost, H, g


@pytest.mark.parametrize("loss", [Trivial(), Cauchy(1.5), GemanMcClure(3.0)], ids=lambda loss: loss.name)
def test_equations_are_those_of_the_factors(loss):
    seen, problem = _both(np.random.default_rng(0))
    problem = with_loss(problem, loss)
    assert {"point_reprojection", "stereo_point", "point_depth", "line_reprojection", "plane_observation"} <= {
        factor.type_name for factor in problem.factors
    }
    for kept, told in ((True, seen), (False, without_prior(seen))):
        found, (cost, H, g) = equations_at(told, START, loss), _summed(problem, kept)
        assert found.cost == pytest.approx(cost, rel=1e-12)
        np.testing.assert_allclose(found.H, H, rtol=1e-10, atol=1e-9 * np.abs(H).max())
        np.testing.assert_allclose(found.g, g, rtol=1e-10, atol=1e-9 * np.abs(g).max())


def test_gradient_is_that_of_the_cost():
    seen, _ = _both(np.random.default_rng(1))
    for loss in (Cauchy(1.5), GemanMcClure(3.0)):
        steps = 1e-6 * np.concatenate([np.eye(6), -np.eye(6)])
        places = POSE_CHARTS["left"].retract(np.tile(START, (12, 1)), steps)
        costs = np.array([equations_at(seen, place, loss).cost for place in places])
        wanted = (costs[:6] - costs[6:]) / 2e-6
        np.testing.assert_allclose(equations_at(seen, START, loss).g, wanted, rtol=1e-5, atol=1e-5 * abs(wanted).max())


@pytest.mark.parametrize("seed", range(4))
def test_the_minimum_is_that_of_the_solver(seed):
    seen, problem = _both(np.random.default_rng(seed))
    exact = SolverOptions(max_iterations=50, function_tolerance=1e-13, eliminate=("frames",))
    pose = START
    for loss in (Cauchy(1.5), GemanMcClure(3.0)):
        problem = solve(with_loss(problem, loss), exact).problem
        pose = fit_pose(seen, pose, loss)
    away = se3.log(se3.compose(pose[None], se3.inverse(problem.variables["frames"].state)))[0]
    H = equations_at(seen, pose, GemanMcClure(3.0)).H
    assert away @ H @ away < 0.1**2  # within a tenth of a standard deviation
    H = equations_at(without_prior(seen), TRUE, GemanMcClure(3.0)).H
    off = se3.log(se3.compose(pose[None], se3.inverse(TRUE[None])))[0]
    assert off @ H @ off < 6.0 + 5.0 * np.sqrt(12.0)  # chi-square of six numbers


def test_what_agrees_is_told_by_its_largest_row():
    seen, _ = _both(np.random.default_rng(2))
    points, lines, planes = equations_at(seen, TRUE, Trivial()).worst
    assert (points[:6] > 5.0).all() and (points[6:] < 5.0).all()
    assert (lines < 5.0).all() and planes == pytest.approx(0.0, abs=1e-9)


def test_a_point_behind_the_camera_has_no_share():
    seen, _ = _both(np.random.default_rng(3))
    whole, alone = (
        equations_at(type(seen)(**{**vars(seen), "points": table}), TRUE, Trivial())
        for table in (np.vstack([seen.points, seen.points[:1] * np.array([1, 1, -1, 1, 1, 1, 1, 1, 1])]), seen.points)
    )
    assert whole.cost == alone.cost
    np.testing.assert_array_equal(whole.H, alone.H)
    assert np.isinf(whole.worst[0][-1])


def test_nothing_seen_stays_where_it_was_expected():
    nothing = np.zeros((0, 9)), np.zeros((0, 18)), np.zeros((0, 17))
    seen = seen_map(CAMERA.params, (0.0, CAMERA.line_baseline), *nothing, PRIOR, SIGMA)
    np.testing.assert_allclose(fit_pose(seen, START, Cauchy(1.5)), PRIOR, atol=1e-6)
