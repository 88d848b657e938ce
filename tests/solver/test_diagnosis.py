# SPDX-License-Identifier: BSD-3-Clause
"""The diagnosis: every case that cannot be observed is named correctly, a sound scene gives no false alarm, suspicious
cameras are found, what is said agrees with the covariances, and the outcome is plain data."""

import dataclasses
import json
from functools import partial
from typing import Any

import numpy as np
import pytest
from problems import INTRINSICS, cameras_on_a_ring, pixels_of, scene_problem

from groma.factors import (
    LineReprojection,
    PlaneObservation,
    PointOnLine,
    PointOnPlane,
    PointReprojection,
    PositionPrior,
)
from groma.factors.contract import Ref
from groma.factors.losses import Tukey
from groma.geometry import se3
from groma.geometry.charts.line_charts import LINE_CHARTS
from groma.geometry.charts.plane_charts import PLANE_CHARTS
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.geometry.manifold import Euclidean
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.solver.covariance.marginals import Covariances
from groma.solver.linear.visible_motion import camera_centers, motion, observers
from groma.solver.observability.diagnosis import diagnose

pytestmark = pytest.mark.kernels


looking = partial(se3.looking_at, up=[0.0, 0.1, 1.0])
ORIGIN = np.zeros(3)


def problem_of(poses, points=None, lines=None, point_obs=None, line_obs=None, planes=None, on_plane=(), held=False,
               free_intrinsics=False):  # fmt: skip
    """An exact problem; everything is seen by every camera unless pairs (landmark, camera) are given."""
    count = len(poses)
    constant = held if isinstance(held, np.ndarray) else np.full(count, held)
    variables = {
        "poses": Variables(POSE_CHARTS["left"], poses, constant),
        "intrinsics": Variables(Euclidean(4, "intrinsics"), INTRINSICS[None], not free_intrinsics),
    }
    factors = []

    def pairs(given, size):
        return np.array([(k, c) for k in range(size) for c in range(count)]) if given is None else np.asarray(given)

    if points is not None:
        points = np.asarray(points, float)
        table = pairs(point_obs, len(points))
        variables["points"] = Variables(Euclidean(3, "point"), points)
        factors.append(
            PointReprojection(
                pose=Ref("poses", table[:, 1]), point=Ref("points", table[:, 0]), camera_model="PINHOLE",
                intrinsics=Ref("intrinsics", np.zeros(len(table), int)),
                pixels=pixels_of(poses[table[:, 1]], points[table[:, 0]]), require_in_front=False,
            )
        )  # fmt: skip
    if lines is not None:
        ends = np.asarray(lines, float)
        table = pairs(line_obs, len(ends))
        chart = LINE_CHARTS["cartesian"]
        plucker = np.hstack([np.cross(ends[:, 0], ends[:, 1]), ends[:, 1] - ends[:, 0]])
        variables["lines"] = Variables(chart, chart.from_ambient(plucker))
        seen = [pixels_of(poses[table[:, 1]], ends[table[:, 0], k]) for k in (0, 1)]
        factors.append(
            LineReprojection(
                pose=Ref("poses", table[:, 1]), line=Ref("lines", table[:, 0]), camera_model="PINHOLE",
                intrinsics=Ref("intrinsics", np.zeros(len(table), int)), segments=np.hstack(seen),
            )
        )  # fmt: skip
    if planes is not None:
        chart = PLANE_CHARTS["normal_offset"]
        variables["planes"] = Variables(chart, chart.from_ambient(np.asarray(planes, float)))
        point, plane = np.asarray(on_plane).T
        factors.append(PointOnPlane(point=Ref("points", point), plane=Ref("planes", plane), sqrt_information=100.0))
    return Problem(variables, factors)


RNG = np.random.default_rng(11)
CLOUD = RNG.uniform(-1.5, 1.5, (40, 3))
RING = cameras_on_a_ring(np.random.default_rng(3), 6)
PAIR = [[0, 0, 0.5], [1, 0, 0.5]]
PATH = looking([[x, -6.0, 0.0] for x in np.linspace(-2, 2, 5)], [[x, -5.0, 0.0] for x in np.linspace(-2, 2, 5)])


def positions_held(problem, cameras):
    """Priors on the positions of some cameras."""
    T = problem.variables["poses"].ambient().reshape(-1, 3, 4)
    centers = -np.einsum("nij,ni->nj", T[:, :, :3], T[:, :, 3])
    prior = PositionPrior(pose=Ref("poses", cameras), cam_center_in_world=centers[cameras], sqrt_information=100.0)
    return Problem(problem.variables, [*problem.factors, prior])


def one_pose_held():
    return problem_of(RING, CLOUD, held=np.arange(6) == 0)


def camera_and_planes(*planes):
    """A camera that sees known planes only."""
    pose = looking([[0.0, -5.0, 1.0]], ORIGIN)
    hesse = np.array(planes, float)
    chart = PLANE_CHARTS["normal_offset"]
    T = se3.to_matrix(pose)[0]
    in_camera = hesse @ np.linalg.inv(T)
    return Problem(
        {"poses": Variables(POSE_CHARTS["left"], pose), "planes": Variables(chart, chart.from_ambient(hesse), True)},
        [
            PlaneObservation(
                pose=Ref("poses", np.zeros(len(hesse), int)), plane=Ref("planes", np.arange(len(hesse))),
                planes_in_cam=in_camera, sqrt_information=100.0,
            )
        ],
    )  # fmt: skip


def two_groups():
    near, far = CLOUD, CLOUD + np.array([100.0, 0, 0])
    poses = np.vstack([RING, looking([[100 + x, -6.0, 0.3 * x] for x in (-2, 0, 2, 3)], (100, 0, 0))])
    table = [(k, c) for k in range(40) for c in range(6)] + [(40 + k, 6 + c) for k in range(40) for c in range(4)]
    return problem_of(poses, np.vstack([near, far]), point_obs=table)


def few_observations():
    table = [(k, c) for k in range(40) for c in range(6) if c != 4 or k < 2]
    return problem_of(RING, CLOUD, point_obs=table)


# name, problem, kind of the finding, what its sentence must say
CASES = [
    ("free scene", lambda: problem_of(RING, CLOUD), "free_motions", ["7 ways", "translation", "rotation", "scale"]),
    ("scale", one_pose_held, "free_motions", ["1 way", ": scale."]),
    (
        "axis", lambda: positions_held(problem_of(RING, CLOUD), [0, 3]), "free_motions",
        ["1 way", "rotation about"],
    ),
    (
        "one known camera position", lambda: positions_held(problem_of(RING, CLOUD), [0]), "free_motions",
        ["4 ways", "rotation and scale"],
    ),
    (
        "pure rotation",
        lambda: problem_of(
            np.vstack([looking([[0, -6.0, 0]], [x, 0, z]) for x in (-1, 0, 1) for z in (-0.5, 0.5)]), CLOUD
        ),
        "pure_rotation", ["only turn", "depth"],
    ),
    (
        "cameras that hardly move",
        lambda: problem_of(
            np.vstack([looking([[0.006 * x, -6.0, 0.006 * z]], [x, 0, z]) for x in (-1, 0, 1) for z in (-0.5, 0.5)]),
            CLOUD,
        ),
        "pure_rotation", ["hardly move", "0.1 % of the viewing distance", "all 40 points"],
    ),
    (
        "one camera", lambda: problem_of(looking([[0, -6.0, 0]], ORIGIN), CLOUD), "point_seen_once",
        ["All points (40 of 40)", "one camera only"],
    ),
    (
        "line along the motion",
        lambda: problem_of(PATH, CLOUD, [[[-1, 0, 1.0], [1, 0, 1.0]], [[0, 0, -1], [0.3, 1, 1]]]),
        "line_along_motion", ["Line 0 ", "along the motion", "slide"],
    ),
    (
        "line in its epipolar plane",
        lambda: problem_of(PATH, CLOUD, [[[-1, 0, 0.0], [1, 1.5, 0.0]], [[0, 0, -1], [0.3, 1, 1]]]),
        "line_in_epipolar_plane", ["Line 0 ", "epipolar plane", "slide"],
    ),
    (
        "line seen once",
        lambda: problem_of(
            PATH, CLOUD, [[[-1, 0, 1.0], [1, 0.5, -1.0]], [[0, 0, -1], [0.3, 1, 1]]],
            line_obs=[(0, 2), *[(1, c) for c in range(5)]],
        ),
        "line_seen_once", ["Line 0 ", "one camera only", "plane through it and the camera"],
    ),
    (
        "point at infinity", lambda: problem_of(RING[:3], np.vstack([CLOUD, [[0.0, 1e5, 2e4]]]), held=True),
        "point_no_parallax", ["Point 40 ", "no parallax", "infinity"],
    ),
    (
        "point seen once",
        lambda: problem_of(RING, CLOUD, point_obs=[(k, c) for k in range(40) for c in range(6) if k != 7 or c == 0]),
        "point_seen_once", ["Point 7 ", "one camera only", "depth"],
    ),
    (
        "plane through two points",
        lambda: problem_of(RING, [*CLOUD, *PAIR], planes=[[0, 0, 1, -0.5]], on_plane=[(40, 0), (41, 0)]),
        "plane_unobservable", ["Plane 0 ", "turn about x", "2 points only"],
    ),
    (
        "plane through one point",
        lambda: problem_of(RING, [*CLOUD, [0, 0, 0.5]], planes=[[0, 0, 1, -0.5]], on_plane=[(40, 0)]),
        "plane_unobservable", ["Plane 0 ", "turn about every axis in it", "1 point only"],
    ),
    (
        "plane seen edge-on",
        lambda: problem_of(PATH, [*CLOUD, [0, 0, 0], [1, 0, 0]], planes=[[0, 0, 1, 0]], on_plane=[(40, 0), (41, 0)]),
        "plane_edge_on", ["Plane 0 ", "turn about x", "edge-on"],
    ),
    (
        "single plane", lambda: camera_and_planes([0, 0, 1, 0]), "camera_unobservable",
        ["Pose 0 ", "move in the plane perpendicular to z", "turn about z"],
    ),
    (
        "two planes", lambda: camera_and_planes([0, 0, 1, 0], [1, 0, 0, -2]), "camera_unobservable",
        ["Pose 0 ", "move along y"],
    ),
    ("planar scene", lambda: problem_of(RING, CLOUD * [1, 1, 0]), "planar_scene", ["one plane", "homography"]),
    ("camera with two points", few_observations, "camera_unobservable", ["Pose 4 ", "4 measured numbers"]),
    ("two groups", two_groups, "separate_parts", ["2 groups", "6 and 4"]),
    (
        "camera without observations",
        lambda: problem_of(RING, CLOUD, point_obs=[(k, c) for k in range(40) for c in range(5)]),
        "no_observations", ["Pose 5 has no observations"],
    ),
    (
        "focal length and depth",
        lambda: problem_of(PATH, CLOUD * [1, 0, 1], free_intrinsics=True), "parameters_unobservable",
        ["Intrinsic 0", "fx, fy, cx and cy", "makes up for them"],
    ),
]  # fmt: skip


CASES_BY_NAME = {case[0]: case[1] for case in CASES}


@pytest.mark.parametrize(("make", "kind", "words"), [case[1:] for case in CASES], ids=[case[0] for case in CASES])
def test_what_is_not_observable_is_named(make, kind, words):
    diagnosis = diagnose(make())
    found = [finding for finding in diagnosis.findings if finding.kind == kind]
    assert len(found) == 1, diagnosis.sentences
    for word in words:
        assert word in found[0].sentence
    problems = {finding.kind for finding in diagnosis.findings if finding.severity == "problem"}
    assert problems <= {kind}, diagnosis.sentences
    json.dumps(diagnosis.to_dict(), allow_nan=False)


@pytest.mark.parametrize("centers", [[[0, -6, 0], [1, -6, 0]], [[0, -6, 0], [1, -6, 0], [2, -6, 0.5]]])
def test_few_cameras_are_no_reason_for_alarm(centers):
    """The frame and the scale of two cameras are those of the scene; no camera is unobservable."""
    diagnosis = diagnose(problem_of(looking(centers, ORIGIN), CLOUD))
    assert [finding.kind for finding in diagnosis.findings] == ["determined", "free_motions"], diagnosis.sentences
    assert diagnosis.num_free_motions == 7


@pytest.mark.parametrize(
    ("make", "gauge", "group"),
    [
        (few_observations, "inner", "poses"),
        (lambda: camera_and_planes([0, 0, 1, 0]), "held", "poses"),
        (lambda: CASES_BY_NAME["plane through two points"](), "inner", "planes"),
    ],
    ids=["camera with two points", "single plane", "plane through two points"],
)
def test_what_can_move_has_no_covariance(make, gauge, group):
    problem = make()
    found = [finding for finding in diagnose(problem).findings if finding.group == group and finding.indices]
    open_ones = sorted(i for finding in found for i in finding.indices)
    assert open_ones == Covariances(problem, gauge=gauge).undetermined(group).tolist() != []


@pytest.mark.parametrize("kept", ["eliminated", "kept"])
def test_weakness_is_the_covariance_with_cameras_held(kept):
    """Points near and far and lines, eliminated or not: the largest standard deviation over the distance."""
    xyz = np.vstack([CLOUD, [[0.0, 10.0**k, 0.2 * 10**k] for k in (3.5, 3.8, 4.2)]])
    problem = problem_of(RING[:3], xyz, RNG.uniform(-1, 1, (12, 2, 3)), held=True)
    if kept == "kept":  # a pair of lines and points that touch: one of the two groups stays
        touch = PointOnLine(point=Ref("points", np.arange(2)), line=Ref("lines", np.arange(2)), sqrt_information=1e-9)
        problem = Problem(problem.variables, [*problem.factors, touch])
    weakness = diagnose(problem).weakness
    covariances = Covariances(problem)
    for name in ("points", "lines"):
        group, seen = problem.variables[name], observers(problem, name, camera_centers(problem))
        J = motion(group.manifold, group.state, seen.middle, seen.distance)
        sigma = np.sqrt(np.linalg.eigvalsh(J @ covariances.of(name) @ np.swapaxes(J, 1, 2))[:, -1])
        # up to a fifth the bound is given that costs nothing, at most the root of the number of directions larger
        weak = sigma > 0.2
        assert weak.sum() == (3 if name == "points" else 0)
        np.testing.assert_allclose(weakness[name][weak], sigma[weak], rtol=1e-4)
        assert (weakness[name][~weak] < 0.2).all() and (weakness[name] > (1 - 1e-4) * sigma).all()


def test_a_point_of_contradicting_matches_is_not_said_to_be_far():
    """Two observations that a robust loss takes the weight of, and wide angles between all rays."""
    problem = problem_of(RING[:3], CLOUD, held=True)
    factor: Any = problem.factors[0]
    pixels = factor.pixels.copy()
    mine = np.flatnonzero(factor.references()[1][1].index == 7)
    pixels[mine[1:]] += 4000.0
    factor = dataclasses.replace(factor, pixels=pixels, loss=Tukey(5.0))
    diagnosis = diagnose(Problem(problem.variables, [factor]))
    found = [finding for finding in diagnosis.findings if finding.severity == "problem"]
    assert [(finding.kind, finding.indices) for finding in found] == [("point_unobservable", (7,))], diagnosis.sentences
    assert "contradict" in found[0].sentence


def test_a_plane_that_nothing_lies_on_is_no_problem():
    problem = problem_of(RING, CLOUD, planes=[[0, 0, 1, 0.0], [0, 1, 0, 5.0]], on_plane=[(k, 0) for k in range(10)])
    diagnosis = diagnose(problem)
    found = [finding for finding in diagnosis.findings if finding.kind == "plane_unused"]
    assert [(finding.severity, finding.indices) for finding in found] == [("warning", (1,))]
    assert found[0].sentence == "Nothing lies on plane 1: it takes no part."


@pytest.mark.parametrize("dense", [300, 0], ids=["decomposed", "by iteration"])
@pytest.mark.parametrize("on_a_line", [1, 40], ids=["alone", "touching each other"])
def test_lines_that_stay_in_the_system_are_judged_like_others(on_a_line, dense, monkeypatch):
    """More points than lines, tied to each other: lines are kept, and those in an epipolar plane are found."""
    monkeypatch.setattr("groma.solver.observability.weak_modes.DENSE", dense)
    ends = np.array([[[-1, 0, 1.0], [1, 0, 1.0]], [[0, 0, -1], [0.3, 1, 1]], [[-1, 0, 0.0], [1, 1.5, 0.0]]])
    xyz = np.vstack([CLOUD, ends[1:2].mean(axis=1)])
    problem = problem_of(PATH, xyz, ends)
    touch = PointOnLine(
        point=Ref("points", np.full(on_a_line, 40)), line=Ref("lines", np.arange(on_a_line) % 2 + (on_a_line == 1)),
        sqrt_information=1e-9,
    )  # fmt: skip
    diagnosis = diagnose(Problem(problem.variables, [*problem.factors, touch]))
    found = {finding.kind: finding.indices for finding in diagnosis.findings if finding.severity == "problem"}
    assert found == {"line_along_motion": (0,), "line_in_epipolar_plane": (2,)}, diagnosis.sentences


@pytest.mark.parametrize("name", ["camera with two points", "two planes", "focal length and depth", "free scene"])
def test_large_systems_are_judged_like_small_ones(name, monkeypatch):
    small = diagnose(CASES_BY_NAME[name]())
    monkeypatch.setattr("groma.solver.observability.weak_modes.DENSE", 0)
    large = diagnose(CASES_BY_NAME[name]())
    assert [finding.kind for finding in large.findings] == [finding.kind for finding in small.findings]
    assert large.num_unobservable_directions == small.num_unobservable_directions


def test_a_sound_scene_gives_no_alarm():
    problem = problem_of(RING, CLOUD, RNG.uniform(-1, 1, (12, 2, 3)), planes=[[0, 0, 1, 0.0]], on_plane=[(0, 0)])
    xyz = CLOUD.copy()
    xyz[:10, 2] = 0.0
    problem = problem_of(
        RING, xyz, RNG.uniform(-1, 1, (12, 2, 3)), planes=[[0, 0, 1, 0.0]], on_plane=[(k, 0) for k in range(10)]
    )
    diagnosis = diagnose(problem)
    assert [finding.kind for finding in diagnosis.findings] == ["determined", "free_motions"]
    assert diagnosis.num_unobservable_directions == 0
    assert (diagnosis.weakness["points"] < 0.01).all()
    held = dataclasses.replace(problem.variables["poses"], constant=np.arange(6) < 2)
    diagnosis = diagnose(Problem({**problem.variables, "poses": held}, problem.factors))
    assert diagnosis.sentences == ["Everything is determined by the data."]
    assert diagnosis.free_motions == ()


@pytest.mark.parametrize("chart", sorted(LINE_CHARTS))
def test_weakness_does_not_depend_on_the_chart(chart):
    expected = diagnose(scene_problem(num_points=20, num_lines=10, disturb=0.0)).weakness["lines"]
    got = diagnose(scene_problem(num_points=20, num_lines=10, disturb=0.0, line_chart=chart)).weakness["lines"]
    np.testing.assert_allclose(got, expected, rtol=1e-6)


def test_a_camera_with_wrong_pixels_stands_out():
    problem = scene_problem(num_points=60, num_cameras=8, noise=0.5)
    factor: Any = problem.factors[0]
    pixels = factor.pixels.copy()
    bad = factor.references()[0][1].index == 3
    pixels[bad] += np.random.default_rng(0).normal(0, 30, (int(bad.sum()), 2))
    diagnosis = diagnose(
        Problem(problem.variables, [dataclasses.replace(factor, pixels=pixels)]), lambda group, i: f"image {i}.png"
    )
    found = [finding for finding in diagnosis.findings if finding.kind == "camera_residuals"]
    assert len(found) == 1
    assert found[0].indices == (3,)
    assert "image 3.png" in found[0].sentence
    assert "Wrong matches" in found[0].sentence


def test_large_counts_have_separators_and_names_have_none():
    """Of 1,300 points, 1,100 are seen once; point 1500 is a name, not a count."""
    cloud = np.random.default_rng(2).uniform(-1.5, 1.5, (1300, 3))
    pairs = [(k, 0) for k in range(1100)] + [(k, c) for k in range(1100, 1300) for c in range(3)]
    diagnosis = diagnose(problem_of(RING, cloud, point_obs=pairs, held=True), lambda group, i: f"point {1500 + i}")
    found = [finding for finding in diagnosis.findings if finding.kind == "point_seen_once"]
    assert "1,100 of 1,300 points are seen by one camera only" in found[0].sentence
    assert "(points 1500, 1501, 1502, 1503, 1504 and 1,095 more)" in found[0].sentence


def test_what_helps_one_landmark_is_said_of_one():
    pairs = [(0, 0)] + [(k, c) for k in range(1, 40) for c in range(6)]
    diagnosis = diagnose(problem_of(RING, CLOUD, point_obs=pairs, held=True))
    assert (
        "Point 0 is seen by one camera only: its depth is not determined. Drop it or add views." in diagnosis.sentences
    )
