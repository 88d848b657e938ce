# SPDX-License-Identifier: BSD-3-Clause
"""Covariances against the inverse of the full normal matrix: all kinds, held and inner gauge, joint blocks, charts;
derived quantities against the motion of the estimate itself; what is not determined; the fronts on sparse patterns."""

import dataclasses

import numpy as np
import pytest
from problems import EXACT, dense_normal_equations, held, scene_problem

from groma.errors import InputError, ProblemError
from groma.factors import LineDirection, SegmentOnPlane
from groma.factors.contract import Ref
from groma.geometry.charts.line_charts import LINE_CHARTS
from groma.geometry.charts.plane_charts import PLANE_CHARTS
from groma.geometry.charts.unit3 import DIRECTION_CHARTS
from groma.geometry.conversions import convert_covariance
from groma.problem.gauge import gauge_directions, world_motions
from groma.problem.lay_out import lay_out
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.solver.covariance import quantities
from groma.solver.covariance.datum import unmoved
from groma.solver.covariance.marginals import Covariances
from groma.solver.linear.dense import Dense
from groma.solver.linear.fronts import Fronts
from groma.solver.solve import solve

pytestmark = pytest.mark.kernels


def structured(**options):
    """A problem with every kind of landmark: points and lines on a plane, lines along a direction."""
    problem = scene_problem(num_points=40, num_lines=10, num_planes=1, **options)
    chart = next(iter(DIRECTION_CHARTS.values()))
    lines = problem.variables["lines"]
    ambient = lines.ambient()
    direction = ambient[0, 3:] / np.linalg.norm(ambient[0, 3:])
    variables = {**problem.variables, "directions": Variables(chart, chart.from_ambient(direction[None]))}
    ends = np.random.default_rng(5).uniform(-1.0, 1.0, (3, 2, 3))
    along = LineDirection(
        line=Ref("lines", np.array([0, 1])), direction=Ref("directions", np.zeros(2, int)), sqrt_information=30.0
    )
    on_plane = SegmentOnPlane(
        line=Ref("lines", np.array([2, 3, 4])), plane=Ref("planes", np.zeros(3, int)), ends=ends, sqrt_information=50.0
    )
    return Problem(variables, [*problem.factors, along, on_plane])


def full_matrix(problem):
    """J^T J over the free coordinates, and where each group lies in it."""
    H, _, columns = dense_normal_equations(problem)
    return H, columns


def full_covariance(problem):
    H, columns = full_matrix(problem)
    free = np.diag(H) > 0
    C = np.zeros_like(H)
    size = np.sqrt(np.diag(H)[free])
    C[np.ix_(free, free)] = np.linalg.inv(H[np.ix_(free, free)] / size[:, None] / size) / size[:, None] / size
    return C, columns


def free_network_covariance(problem, weights):
    """Inner constraints by the bordered system: J^T J with the condition that weighted motions vanish."""
    H, columns = full_matrix(problem)
    motions = world_motions(problem)
    G, D = np.zeros((len(H), 7)), np.zeros(len(H))
    for name, (first, dof) in columns.items():
        size = len(problem.variables[name]) * dof
        G[first : first + size] = motions[name].transpose(1, 2, 0).reshape(size, 7)
        if name in weights:
            D[first : first + size] = np.broadcast_to(weights[name], (size // dof, dof)).reshape(-1)
    size = np.sqrt(np.diag(H))
    B = (D[:, None] * G) / size[:, None]
    B /= np.linalg.norm(B, axis=0)
    bordered = np.block([[H / size[:, None] / size, B], [B.T, np.zeros((7, 7))]])
    return np.linalg.inv(bordered)[: len(H), : len(H)] / size[:, None] / size, columns


def assert_blocks(covariances, expected, columns, tolerance=1e-6):
    for name, (first, dof) in columns.items():
        got = covariances.of(name)
        for k in range(len(got)):
            at = slice(first + k * dof, first + (k + 1) * dof)
            np.testing.assert_allclose(
                got[k], expected[at, at], atol=tolerance * np.abs(expected[at, at]).max(), rtol=0
            )


@pytest.mark.compiled
@pytest.mark.parametrize(
    "case",
    [{}, {"num_lines": 8}, {"num_lines": 8, "num_planes": 1}, {"shared_intrinsics": True, "num_points": 60},
     {"shared_intrinsics": False, "num_points": 100, "num_cameras": 10, "views": 8},
     {"num_cameras": 18, "views": 3, "num_points": 120}],
)  # fmt: skip
def test_equals_inverse_of_full_matrix(case):
    problem = solve(held(scene_problem(**case)), EXACT).problem
    assert_blocks(Covariances(problem), *full_covariance(problem))


@pytest.mark.compiled
@pytest.mark.parametrize("line_chart", ["cartesian", "orthonormal_right", "free_left"])
def test_every_kind_together(line_chart):
    problem = solve(held(structured(line_chart=line_chart)), EXACT).problem
    expected, columns = full_covariance(problem)
    covariances = Covariances(problem)
    assert_blocks(covariances, expected, columns)
    wanted = [("poses", 2), ("points", 3), ("points", 25), ("lines", 1), ("planes", 0), ("directions", 0), ("lines", 7)]
    rows = np.concatenate([columns[g][0] + i * columns[g][1] + np.arange(columns[g][1]) for g, i in wanted])
    block = expected[np.ix_(rows, rows)]
    size = np.sqrt(np.diag(block))
    np.testing.assert_allclose(
        covariances.joint(wanted) / size[:, None] / size, block / size[:, None] / size, atol=1e-6
    )


@pytest.mark.parametrize(
    "weights",
    [{"poses": 1.0}, {"poses": [1, 1, 1, 0, 0, 0]}, {"points": 1.0}, {"points": 1.0, "poses": [1, 1, 1, 0, 0, 0]}],
)
@pytest.mark.parametrize("case", [{}, {"num_lines": 8, "line_chart": "orthonormal_left"}])
def test_inner_constraints_are_the_bordered_inverse(case, weights):
    problem = solve(scene_problem(num_points=40, **case), EXACT).problem
    expected, columns = free_network_covariance(problem, weights)
    covariances = Covariances(problem, gauge="inner", datum=weights)
    assert_blocks(covariances, expected, columns)
    wanted = [("points", 0), ("poses", 3), ("points", 39)]
    rows = np.concatenate([columns[g][0] + i * columns[g][1] + np.arange(columns[g][1]) for g, i in wanted])
    np.testing.assert_allclose(
        covariances.joint(wanted), expected[np.ix_(rows, rows)], atol=1e-6 * np.abs(expected[np.ix_(rows, rows)]).max()
    )


def test_inner_gauge_by_default_is_the_pseudo_inverse_of_the_cameras():
    problem = solve(scene_problem(num_points=40), EXACT).problem
    H, columns = full_matrix(problem)
    first, dof = columns["poses"]
    size = len(problem.variables["poses"]) * dof
    points, point_dof = columns["points"]
    stop = points + len(problem.variables["points"]) * point_dof
    W = H[first : first + size, points:stop]
    S = H[first : first + size, first : first + size] - W @ np.linalg.solve(H[points:stop, points:stop], W.T)
    expected = np.linalg.pinv(S, rcond=1e-10, hermitian=True)
    got = Covariances(problem, gauge="inner").of("poses")
    for k in range(len(got)):
        block = expected[k * dof : (k + 1) * dof, k * dof : (k + 1) * dof]
        np.testing.assert_allclose(got[k], block, atol=1e-6 * np.abs(block).max())


def test_the_gauge_does_not_change_what_can_be_measured():
    problem = solve(scene_problem(num_points=40, num_lines=6), EXACT).problem
    sizes = []
    for datum in ({"poses": 1.0}, {"points": 1.0}, {"poses": [1, 1, 1, 0, 0, 0]}):
        covariances = Covariances(problem, gauge="inner", datum=datum)
        angle = quantities.angle_between_lines(covariances, ("lines", 0), ("lines", 1))
        ratio = covariances.derived(
            lambda a, b, c: np.linalg.norm(a - b) / np.linalg.norm(b - c), [("points", 0), ("points", 1), ("points", 2)]
        )
        sizes.append([angle.sigma, ratio.sigma[0]])
    np.testing.assert_allclose(sizes[1:], [sizes[0]] * 2, rtol=1e-5)


def test_a_prior_leaves_only_what_it_leaves():
    """With one pose held the scale alone is free; inner constraints then fix the scale and nothing else."""
    problem = scene_problem(num_points=40)
    constant = np.zeros(len(problem.variables["poses"]), bool)
    constant[0] = True
    poses = dataclasses.replace(problem.variables["poses"], constant=constant)
    problem = solve(Problem({**problem.variables, "poses": poses}, problem.factors), EXACT).problem
    covariances = Covariances(problem, gauge="inner")
    assert np.abs(covariances.of("poses", 0)).max() == 0.0
    H, _ = full_matrix(problem)
    free = np.diag(H) > 0
    null = np.linalg.eigvalsh(H[np.ix_(free, free)])
    assert (null < 1e-9 * null.max()).sum() == 1
    assert np.isfinite(covariances.of("points")).all()


@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("seed", range(8))
def test_one_held_pose_leaves_the_scale_alone(seed, unit):
    """Whatever the rounding and the unit: of seven motions one combination leaves the pose, and two poses leave none.

    A held position leaves the turns about it and the scale, a held orientation the translations and the scale.
    """
    poses = scene_problem(seed=seed, num_points=10).variables["poses"]
    state = poses.state * [1, 1, 1, 1, unit, unit, unit]
    motions = gauge_directions(poses.manifold, state, unit * np.array([0.1, 0.2, 0.3]), 2.0 * unit)
    (only,) = unmoved(motions[:, 0].T, 2.0 * unit).T
    np.testing.assert_allclose(motions[:, 0].T @ only, 0.0, atol=1e-12 * max(unit, 1.0))
    assert abs(only[6]) > 0.1
    assert unmoved(motions[:, :2].reshape(7, -1).T, 2.0 * unit).shape == (7, 0)
    assert unmoved(motions[:, 0, :3].T, 2.0 * unit).shape == (7, 4)
    assert unmoved(motions[:, 0, 3:].T, 2.0 * unit).shape == (7, 4)


def test_free_scene_is_refused_with_the_remedy():
    with pytest.raises(ProblemError, match=r"rank deficient by 7.*gauge='inner'"):
        Covariances(scene_problem(num_points=40))


def test_structure_only():
    problem = scene_problem(num_points=20, constant_poses=True)
    expected, columns = full_covariance(problem)
    assert_blocks(Covariances(problem), expected, {"points": columns["points"]}, 1e-8)


@pytest.mark.compiled
@pytest.mark.parametrize(("group", "charts"), [("lines", LINE_CHARTS), ("planes", PLANE_CHARTS)])
def test_covariances_are_carried_between_charts(group, charts):
    problem = solve(held(structured()), EXACT).problem
    variables = problem.variables[group]
    covariances = Covariances(problem)
    for name, chart in charts.items():
        states = {group: chart.from_ambient(variables.ambient())}
        other = Problem({**problem.variables, group: Variables(chart, states[group])}, problem.factors)
        expected = Covariances(other).of(group)
        got = covariances.in_chart(group, chart)
        np.testing.assert_allclose(got, expected, atol=1e-6 * np.abs(expected).max(), err_msg=name)
        back = convert_covariance(got, states[group], chart, variables.manifold)
        np.testing.assert_allclose(back, covariances.of(group), atol=1e-7 * np.abs(back).max(), err_msg=name)


@pytest.mark.compiled
def test_derived_quantities_follow_the_estimate():
    """The analytic way: J Sigma J^T with the Jacobian written by hand."""
    problem = solve(held(structured()), EXACT).problem
    covariances = Covariances(problem)
    a, b = problem.variables["points"].state[[0, 5]]
    sigma = covariances.joint([("points", 0), ("points", 5)])
    u = (b - a) / np.linalg.norm(b - a)
    row = np.concatenate([-u, u])
    length = quantities.length_between_points(covariances, ("points", 0), ("points", 5))
    assert length.value == pytest.approx(np.linalg.norm(b - a))
    assert length.sigma == pytest.approx(np.sqrt(row @ sigma @ row), rel=1e-6)

    plane = problem.variables["planes"].ambient()[0]
    distance = quantities.distance_point_plane(covariances, ("points", 3), ("planes", 0))
    basis = problem.variables["planes"].manifold.basis(problem.variables["planes"].state[:1])[0]
    point = problem.variables["points"].state[3]
    row = np.concatenate([plane[:3], np.append(point, 1.0) @ basis])
    sigma = covariances.joint([("points", 3), ("planes", 0)])
    assert distance.value == pytest.approx(plane[:3] @ point + plane[3], abs=1e-12)
    assert distance.sigma == pytest.approx(np.sqrt(row @ sigma @ row), rel=1e-6)

    d = problem.variables["lines"].ambient()[:, 3:]
    angle = quantities.angle_between_lines(covariances, ("lines", 5), ("lines", 6))
    cosine = abs(d[5] @ d[6]) / np.linalg.norm(d[5]) / np.linalg.norm(d[6])
    assert angle.value == pytest.approx(np.arccos(cosine))
    assert 0 < angle.sigma < 0.1

    # a line and itself: the angle is zero with certainty, a plane and itself likewise
    assert quantities.angle_between_lines(covariances, ("lines", 5), ("lines", 5)).sigma < 1e-6
    assert quantities.distance_between_planes(covariances, ("planes", 0), ("planes", 0)).sigma < 1e-8
    baseline = quantities.distance_between_cameras(covariances, ("poses", 0), ("poses", 1))
    assert baseline.sigma > 0
    with pytest.raises(InputError, match="kind 'line'"):
        quantities.angle_between_lines(covariances, ("points", 0), ("lines", 1))


@pytest.mark.compiled
@pytest.mark.parametrize("num_cameras", [3, 14, 60])
def test_fronts_equal_the_dense_inverse(num_cameras):
    """Random symmetric positive blocks on the pattern of a chain with loop closures."""
    rng = np.random.default_rng(num_cameras)
    problem = scene_problem(num_cameras=num_cameras, num_points=4 * num_cameras, views=2, num_planes=1)
    layout = lay_out(problem)
    n = layout.num_kept_unknowns
    blocks = {
        pair: rng.normal(size=(len(rows), layout.kept[pair[0]].width, layout.kept[pair[1]].width))
        for pair, (rows, _) in layout.blocks.items()
    }
    for c, kept in enumerate(layout.kept):
        diagonal = blocks[c, c][: kept.count]
        blocks[c, c][: kept.count] = diagonal + np.swapaxes(diagonal, 1, 2) + n * np.eye(kept.width)
    S = np.zeros((n, n))
    Dense(layout).fill(blocks, S)
    S = np.triu(S) + np.triu(S, 1).T
    fronts = Fronts(layout)
    assert fronts.factorize(blocks)
    expected = np.linalg.inv(S)
    for (a, b), inverse in fronts.inverse_on_pattern().items():
        rows, columns = layout.blocks[a, b]
        r = layout.kept[a].start + rows[:, None, None] * layout.kept[a].width + np.arange(layout.kept[a].width)[:, None]
        c = layout.kept[b].start + columns[:, None, None] * layout.kept[b].width + np.arange(layout.kept[b].width)
        np.testing.assert_allclose(inverse, expected[r, c], atol=1e-12 * np.abs(expected).max())
    rhs = rng.normal(size=(n, 3))
    np.testing.assert_allclose(fronts.solve(rhs), expected @ rhs, atol=1e-12)
    blocks[0, 0][0] = -blocks[0, 0][0]
    assert not fronts.factorize(blocks)


def test_wrong_questions_are_refused():
    problem = solve(held(scene_problem()), EXACT).problem
    covariances = Covariances(problem)
    with pytest.raises(InputError, match="no group 'line'"):
        covariances.of("line")
    with pytest.raises(InputError, match="0 to 29"):
        covariances.of("points", 30)
    free = scene_problem()
    with pytest.raises(InputError, match="does not fix the frame"):
        Covariances(free, gauge="inner", datum={"poses": [[1, 1, 1, 1, 1, 1], *[[0] * 6] * 4]})
    with pytest.raises(InputError, match="names 'point'"):
        Covariances(free, gauge="inner", datum={"point": 1.0})
    with pytest.raises(InputError, match="must broadcast"):
        Covariances(free, gauge="inner", datum={"points": [1.0, 2.0]})
