"""Small problems for the solver tests, and a plain dense evaluation to compare with."""

from __future__ import annotations

import dataclasses

import numpy as np

from groma.factors import LineReprojection, PointOnPlane, PointReprojection
from groma.factors.contract import Ref
from groma.factors.losses import Trivial
from groma.geometry import se3
from groma.geometry.charts.line_charts import LINE_CHARTS
from groma.geometry.charts.plane_charts import PLANE_CHARTS
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.geometry.manifold import Euclidean
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.solver.options import SolverOptions

INTRINSICS = np.array([800.0, 780.0, 500.0, 400.0])

#: Until nothing moves any more.
EXACT = SolverOptions(function_tolerance=1e-12)


def held(problem):
    """Hold the first pose and one coordinate of the second."""
    constant = np.zeros((len(problem.variables["poses"]), 6), dtype=bool)
    constant[0] = True
    constant[1, 2] = True
    variables = dict(problem.variables)
    variables["poses"] = dataclasses.replace(variables["poses"], constant=constant)
    return Problem(variables, problem.factors)


def cameras_on_a_ring(rng, count: int, radius: float = 6.0):
    """Poses (count, 7) that look at the origin from a ring, slightly disturbed."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    centers = np.stack([radius * np.cos(angle), radius * np.sin(angle), rng.normal(0, 0.5, count)], axis=1)
    return se3.looking_at(centers, np.zeros(3))


def pixels_of(poses, points):
    in_camera = se3.transform_points(poses, points)
    return INTRINSICS[:2] * in_camera[:, :2] / in_camera[:, 2:] + INTRINSICS[2:]


def scene_problem(
    seed=0, num_cameras=5, num_points=30, num_lines=0, num_planes=0, noise=0.5, disturb=0.01, shared_intrinsics=None,
    loss=None, line_chart="cartesian", plane_chart="normal_offset", pose_chart="left", constant_poses=False,
    constant_landmarks=False, views=4,
):  # fmt: skip
    """Points, lines and planes seen by a ring of cameras; start disturbed from the truth.

    ``shared_intrinsics``: None (fixed), True (one free set for all) or False (a free set for each camera).
    """
    rng = np.random.default_rng(seed)
    loss = loss or Trivial()
    poses = cameras_on_a_ring(rng, num_cameras)
    points = rng.uniform(-1.5, 1.5, (num_points, 3))
    num_sets = num_cameras if shared_intrinsics is False else 1
    intrinsics = np.tile(INTRINSICS, (num_sets, 1))
    chart = POSE_CHARTS[pose_chart]
    start = chart.retract(poses, disturb * rng.normal(size=(num_cameras, 6)))
    free = shared_intrinsics is not None
    if free:
        intrinsics = intrinsics * (1 + 0.01 * rng.normal(size=intrinsics.shape))
    variables = {
        "poses": Variables(chart, poses if constant_poses else start, constant_poses),
        "intrinsics": Variables(Euclidean(4, "intrinsics"), intrinsics, not free),
    }
    factors = []
    if num_points:
        if num_planes:
            points[: num_points // 2, 2] = 0.3
        camera = np.concatenate([rng.permutation(num_cameras)[:views] for _ in range(num_points)])
        point = np.repeat(np.arange(num_points), min(views, num_cameras))
        order = rng.permutation(len(point))
        camera, point = camera[order], point[order]
        pixels = pixels_of(poses[camera], points[point]) + noise * rng.normal(size=(len(point), 2))
        state = points if constant_landmarks else points + 2 * disturb * rng.normal(size=points.shape)
        variables["points"] = Variables(Euclidean(3, "point"), state, constant_landmarks)
        factors.append(
            PointReprojection(
                pose=Ref("poses", camera),
                point=Ref("points", point),
                intrinsics=Ref("intrinsics", camera if num_sets > 1 else np.zeros_like(camera)),
                camera_model="PINHOLE",
                pixels=pixels,
                sqrt_information=1.0 / max(noise, 1e-3),
                loss=loss,
            )
        )
    if num_lines:
        ends = rng.uniform(-1.5, 1.5, (num_lines, 2, 3))
        camera = np.concatenate([rng.permutation(num_cameras)[:views] for _ in range(num_lines)])
        line = np.repeat(np.arange(num_lines), min(views, num_cameras))
        segment = np.hstack([pixels_of(poses[camera], ends[line, k]) for k in (0, 1)])
        segment += noise * rng.normal(size=segment.shape)
        moved = ends if constant_landmarks else ends + 2 * disturb * rng.normal(size=ends.shape)
        plucker = np.hstack([np.cross(moved[:, 0], moved[:, 1]), moved[:, 1] - moved[:, 0]])
        lines = LINE_CHARTS[line_chart]
        variables["lines"] = Variables(lines, lines.from_ambient(plucker), constant_landmarks)
        factors.append(
            LineReprojection(
                pose=Ref("poses", camera),
                line=Ref("lines", line),
                intrinsics=Ref("intrinsics", camera if num_sets > 1 else np.zeros_like(camera)),
                camera_model="PINHOLE",
                segments=segment,
                sqrt_information=1.0 / max(noise, 1e-3),
                loss=loss,
            )
        )
    if num_planes:
        planes = PLANE_CHARTS[plane_chart]
        on_plane = np.arange(num_points // 2)
        state = planes.from_ambient(np.tile([0.01, -0.01, 1.0, -0.31], (num_planes, 1)))
        variables["planes"] = Variables(planes, state)
        factors.append(
            PointOnPlane(
                point=Ref("points", on_plane), plane=Ref("planes", on_plane % num_planes), sqrt_information=200.0
            )
        )
    return Problem(variables, factors)


def dense_normal_equations(problem: Problem):
    """Return (J^T J, J^T r, columns of each group) over the free groups, by the plainest possible means."""
    columns, width = {}, 0
    for name, group in problem.variables.items():
        if not group.is_constant:
            columns[name] = (width, group.manifold.dof)
            width += len(group) * group.manifold.dof
    H, g = np.zeros((width, width)), np.zeros(width)
    for factor in problem.factors:
        references = factor.references()
        groups = [problem.variables[ref.group] for _, ref in references]
        sizes = [group.manifold.factor_columns for group in groups]
        starts = np.concatenate([[0], np.cumsum(sizes)])
        record = np.zeros((len(factor), factor.residual_size, starts[-1] + 1))
        inputs = factor.prepare(tuple(group.ambient() for group in groups))
        factor.linearize(inputs, 0, len(factor), tuple(int(s) for s in starts[:-1]), record)
        bases = [group.manifold.basis(group.state) for group in groups]
        information = np.broadcast_to(np.asarray(factor.sqrt_information, float), (len(factor),))
        for i in range(len(factor)):
            J = np.zeros((factor.residual_size, width))
            r = record[i, :, -1] * information[i]
            for b, (_, ref) in enumerate(references):
                if ref.group not in columns:
                    continue
                block = record[i, :, starts[b] : starts[b + 1]] * information[i]
                k = ref.index[i]
                if bases[b] is not None:
                    block = block @ bases[b][k]
                free = groups[b].free_coordinates()
                if free is not None:
                    block = block * free[k]
                first, dof = columns[ref.group]
                J[:, first + k * dof : first + (k + 1) * dof] += block
            weight = np.sqrt(factor.loss.evaluate(np.array([r @ r]))[1][0])
            H += weight**2 * J.T @ J
            g += weight**2 * J.T @ r
    return H, g, columns
