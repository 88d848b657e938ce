# SPDX-License-Identifier: BSD-3-Clause
"""Landmarks and cameras that the data do not determine have no covariance and do not spoil that of the others."""

import dataclasses

import numpy as np
import pytest
from problems import EXACT, held, pixels_of, scene_problem

from groma.errors import ProblemError
from groma.factors import LineReprojection, PointOnPlane, PointReprojection
from groma.factors.contract import Ref
from groma.geometry.manifold import Euclidean
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.solver.covariance.marginals import Covariances
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

pytestmark = pytest.mark.kernels


def test_landmarks_that_are_not_determined_have_no_covariance():
    problem = scene_problem(num_points=20)
    poses = dataclasses.replace(problem.variables["poses"], constant=True)
    points = problem.variables["points"]
    more = dataclasses.replace(points, state=np.vstack([points.state, [[0.1, 0.2, 0.3]]]))
    factor = problem.factors[0]
    once = PointReprojection(
        pose=Ref("poses", [0]), point=Ref("points", [20]), intrinsics=Ref("intrinsics", [0]), camera_model="PINHOLE",
        pixels=np.array([[500.0, 400.0]]),
    )  # fmt: skip
    covariances = Covariances(Problem({**problem.variables, "poses": poses, "points": more}, [factor, once]))
    assert covariances.undetermined("points").tolist() == [20]
    assert np.isnan(covariances.of("points", 20)).all()
    assert np.isfinite(covariances.of("points", np.arange(20))).all()


def test_a_loose_plane_does_not_spoil_the_rest():
    """A second plane that only two points lie on can turn about them; everything else keeps its covariance."""
    problem = held(scene_problem(num_points=40, num_planes=1))
    chart = problem.variables["planes"].manifold
    planes = Variables(
        chart, np.vstack([problem.variables["planes"].state, chart.from_ambient(np.array([[1, 0, 0, 0.2]]))])
    )
    both = PointOnPlane(point=Ref("points", [30, 31]), plane=Ref("planes", [1, 1]), sqrt_information=200.0)
    expected = Covariances(solve(problem, EXACT).problem)
    loose = Problem({**problem.variables, "planes": planes}, [*problem.factors, both])
    loose = solve(loose, SolverOptions(function_tolerance=1e-14)).problem
    covariances = Covariances(loose)
    assert covariances.undetermined("planes").tolist() == [1]
    assert covariances.undetermined("points").tolist() == []
    assert np.isnan(covariances.of("planes", 1)).all()
    for group in ("poses", "points"):  # a plane through two points says nothing about them
        np.testing.assert_allclose(covariances.of(group), expected.of(group), rtol=1e-3, atol=1e-3 * 1e-6)


def test_many_loose_planes_do_not_spoil_the_rest():
    """Sixty planes through two points each: more directions are open than cameras have unknowns."""
    problem = held(scene_problem(num_points=40, num_planes=1))
    chart = problem.variables["planes"].manifold
    points = problem.variables["points"].state
    first, second = np.arange(60) % 20 + 20, (np.arange(60) + 1 + np.arange(60) // 20) % 20 + 20
    normal = np.cross(points[first] - points[second], np.random.default_rng(7).normal(size=(60, 3)))
    hesse = np.hstack([normal, -np.einsum("ni,ni->n", normal, points[first])[:, None]])
    planes = Variables(chart, np.vstack([problem.variables["planes"].state, chart.from_ambient(hesse)]))
    index = np.arange(1, 61)
    on = PointOnPlane(
        point=Ref("points", np.concatenate([first, second])), plane=Ref("planes", np.concatenate([index, index])),
        sqrt_information=200.0,
    )  # fmt: skip
    expected = Covariances(problem)
    covariances = Covariances(Problem({**problem.variables, "planes": planes}, [*problem.factors, on]))
    assert covariances.undetermined("planes").tolist() == index.tolist()
    assert not len(covariances.undetermined("poses")) and not len(covariances.undetermined("points"))
    for group in ("poses", "points"):  # points on planes that can turn about them are where their images say
        np.testing.assert_allclose(covariances.of(group), expected.of(group), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(covariances.of("planes", 0), expected.of("planes", 0), rtol=1e-6)


@pytest.mark.parametrize(
    ("distance", "seen", "end"),
    [
        (1e-3, [0, 2, 4], [0.3, -0.2, 0.4]),
        (9.6866751699232e-09, [0, 2], [0.9244102554407045, -0.03346189161222024, 1.4660860001034592]),
        (1.9560141869114527e-08, [1, 2], [-1.031593555827923, 0.6348617366427525, 1.0323329047171277]),
    ],
)
def test_a_line_through_the_centre_of_a_camera_does_not_spoil_the_rest(distance, seen, end):
    """Its image turns by any angle when it moves by next to nothing. Eliminated by the inverse of its block, the last
    two would spoil the third and the fifth digit of the poses; they must be as if the lines stayed in the system."""
    problem = solve(held(scene_problem(num_lines=8, num_cameras=5, views=5)), EXACT).problem
    lines, end = problem.variables["lines"], np.array(end)
    T = problem.variables["poses"].ambient()[2].reshape(3, 4)
    center = -T[:, :3].T @ T[:, 3]
    aside = np.cross(end - center, [0.1, 0.2, 1.0])
    start = center + distance * aside / np.linalg.norm(aside)
    plucker = np.append(np.cross(start, end), end - start)
    state = np.vstack([lines.state, lines.manifold.from_ambient(plucker[None])])
    factor = next(f for f in problem.factors if f.type_name == "line_reprojection")
    count, ends = len(seen), np.stack([end, end + 0.1 * (end - start)])
    more = LineReprojection(
        pose=Ref("poses", seen), line=Ref("lines", [8] * count), intrinsics=Ref("intrinsics", [0] * count),
        camera_model="PINHOLE", sqrt_information=factor.sqrt_information,
        segments=np.hstack([pixels_of(problem.variables["poses"].state[seen], np.tile(p, (count, 1))) for p in ends]),
    )  # fmt: skip
    variables = {**problem.variables, "lines": dataclasses.replace(lines, state=state)}
    problem = Problem(variables, [*problem.factors, more])
    covariances, kept = Covariances(problem), Covariances(problem, eliminate=("points",))
    for group in ("poses", "points"):
        np.testing.assert_allclose(
            covariances.of(group), kept.of(group), rtol=0, atol=1e-7 * np.abs(kept.of(group)).max()
        )


def test_lost_cameras_are_an_error():
    """Two of five cameras that see nothing in common with the others: there is nothing to refer them to."""
    problem = held(scene_problem(num_points=30, views=3))
    factor = problem.factors[0]
    rows = np.flatnonzero((factor.pose.index < 3) | (factor.point.index > 26))
    with pytest.raises(ProblemError, match=r"rank deficient by \d+; 2 of 5 poses are not determined.*diagnose"):
        Covariances(Problem(problem.variables, [factor.take(rows)]))


@pytest.mark.parametrize("count", [1, 2, 4])
@pytest.mark.parametrize("constant", [[False, False, False], [False, True, True], [True, True, False]])
@pytest.mark.parametrize("seed", range(3))
def test_a_plane_on_points_seen_once_is_not_determined(seed, constant, count):
    """Elimination of the points leaves rounding of it: no deviation is made of that, whichever way it falls."""
    problem = held(scene_problem(num_points=40, num_planes=1, seed=seed))
    seen, on = problem.factors
    alone = np.arange(30, 30 + count)
    once = np.unique(seen.point.index, return_index=True)[1]
    seen = seen.take(np.flatnonzero(~np.isin(seen.point.index, alone) | np.isin(np.arange(len(seen)), once)))
    group = problem.variables["planes"]
    state = np.vstack([group.state, group.manifold.from_ambient(np.array([[1, 0.1, 0, 0.2]]))])
    planes = Variables(group.manifold, state, np.array([[False] * 3, constant]))
    both = PointOnPlane(point=Ref("points", alone), plane=Ref("planes", np.ones(count, int)), sqrt_information=200.0)
    covariances = Covariances(Problem({**problem.variables, "planes": planes}, [seen, on, both]))
    assert covariances.undetermined("planes").tolist() == [1]
    assert covariances.undetermined("points").tolist() == alone.tolist()
    assert np.isfinite(covariances.of("planes", 0)).all() and np.isfinite(covariances.of("poses")).all()


def test_variables_without_a_measurement_have_no_covariance():
    """Of a whole group, too; what is held of it is certain."""
    problem = held(scene_problem(num_points=30))
    spare = Variables(Euclidean(3, "point"), np.zeros((3, 3)), np.array([False, True, False]))
    covariances = Covariances(Problem({**problem.variables, "spare": spare}, problem.factors))
    assert covariances.undetermined("spare").tolist() == [0, 2]
    assert np.isnan(covariances.of("spare")).all(axis=(1, 2)).tolist() == [True, False, True]
    assert not covariances.of("spare", 1).any()
    joint = covariances.joint([("points", 0), ("spare", 2), ("points", 0), ("spare", 1), ("points", 0)])
    own = covariances.of("points", 0)[0]
    for row in (0, 6, 12):
        for column in (0, 6, 12):
            np.testing.assert_allclose(joint[row : row + 3, column : column + 3], own, rtol=1e-6)
    assert np.isnan(joint[3:6]).all() and not joint[9:12, 9:12].any()


def test_one_observation_of_one_point_determines_nothing():
    """The point takes up both residuals: the motions of the world move nothing that is seen, and none is a datum."""
    problem = scene_problem(num_points=20)
    poses, points = problem.variables["poses"], problem.variables["points"]
    one = dataclasses.replace(poses, state=poses.state[:1]), dataclasses.replace(points, state=points.state[:1])
    factor = PointReprojection(
        pose=Ref("poses", [0]), point=Ref("points", [0]), intrinsics=Ref("intrinsics", [0]), camera_model="PINHOLE",
        pixels=np.array([[500.0, 400.0]]),
    )  # fmt: skip
    alone = Problem({**problem.variables, "poses": one[0], "points": one[1]}, [factor])
    assert np.isnan(Covariances(alone, gauge="inner").of("poses")).all()
