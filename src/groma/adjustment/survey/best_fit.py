# SPDX-License-Identifier: BSD-3-Clause
r"""Where a whole scene fits its measurements best, its inner geometry as it is.

Images do not notice a similarity of the whole scene. Measurements of the ground do, but beside hundreds of thousands of
pixels they weigh little: damped steps creep along these seven directions. Here they are alone: with their residuals r,
as the terms of the adjustment make them, and the motions g of the seven directions
(:mod:`groma.problem.gauge`)

.. math:: \min_{a, \varphi, \sigma} \sum_i \rho\left(\lVert r_i \rVert^2_{\Sigma_i}\right), \qquad
          \frac{\partial r_i}{\partial (a, \varphi, \sigma)} = \sum_b J_{ib}\, g_b

by reweighted Gauss-Newton steps about the middle of the scene.
"""

from __future__ import annotations

import math

import numpy as np

from groma._typing import FloatArray
from groma.adjustment.assemble import camera_variables, structure_variables
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.terms import camera_poses, control_points, distances, known_geometry
from groma.adjustment.terms.contract import Draft
from groma.factors.contract import Factor
from groma.geometry import line3, so3
from groma.geometry.charts.line_charts import LINE_CHARTS
from groma.geometry.incidence import closest_points
from groma.geometry.manifold import Euclidean
from groma.problem.gauge import world_motions
from groma.problem.problem import Problem
from groma.problem.residuals import jacobians_of, residuals_of, root_matrices
from groma.problem.variables import Variables
from groma.scene import Distances, Keypoints, Scene, Similarity
from groma.scene.survey import Kind, accepted

#: Cost: steps of a fit that ends before, and where it has converged.
_STEPS, _TOLERANCE = 50, 1e-6
#: Directions of less than this share of the information of others are not known.
_UNKNOWN = 1e-13
#: What is left by rounding of numbers that cancel.
_ROUNDING = 1e-12
#: Terms whose measurements notice where the scene is.
_TERMS = (
    camera_poses.PRIORS, camera_poses.POSITIONS, camera_poses.POSES, control_points.CONTROL, distances.TERM,
    known_geometry.PLANES, known_geometry.DIRECTIONS,
)  # fmt: skip


def best_fitted(scene: Scene) -> Scene:
    """Return a scene that measurements of other instruments place where these fit best; what was measured stays.

    The scale is kept, too, if depths or stereo pairs determine it; scenes with held objects are left unchanged.
    """
    similarity = best_fit(scene)
    return scene if similarity is None else moved_to(scene, similarity)


def best_fit(scene: Scene) -> Similarity | None:
    """Return the motion that :func:`best_fitted` moves a scene by; None where it stays."""
    if not (scene.has_survey or len(scene.pose_priors)) or len(scene.held) or not scene.num_images:
        return None
    return _best(scene)


def moved_to(scene: Scene, similarity: Similarity) -> Scene:
    """Return a scene moved by a similarity; what was measured of it stays."""
    return scene.transformed(similarity, measured=False).replace(pose_priors=scene.pose_priors)


def _best(scene: Scene) -> Similarity:
    """Return the similarity to where a scene fits best."""
    light = _with_positions(accepted(scene).keep(points=[], line_observations=[]).replace(keypoints=Keypoints()))
    centers = light.cam_centers_in_world
    middle, total = centers.mean(axis=0), Similarity()
    length = float(np.median(np.linalg.norm(centers - middle, axis=1))) or 1.0
    free = 6 if scene.is_metric else 7
    for _ in range(_STEPS):
        normal, gradient = _normal_equations(_problem(light), total.points(middle), length * total.scale)
        most = max(float(np.diag(normal).max()), 1e-300)
        size = np.sqrt(np.maximum(np.diag(normal)[:free], _UNKNOWN * most))  # what nothing measured is left alone
        scaled = normal[:free, :free] / size / size[:, None]
        step = np.zeros(7)
        step[:free] = -np.linalg.pinv(scaled, rcond=_UNKNOWN, hermitian=True) @ (gradient[:free] / size) / size
        next_ = _similarity(step, total.points(middle), length * total.scale)
        light, total = moved_to(light, next_), next_.after(total)
        if np.abs(step[:free] * size).max() <= _TOLERANCE:  # in standard deviations
            break
    return total


def _similarity(step: FloatArray, center: FloatArray, length: float) -> Similarity:
    """Return the similarity of a step (7,): a shift in lengths, a turn about the center, a logarithm of scale."""
    turn = step[3:6] * min(1.0, 1.0 / max(float(np.linalg.norm(step[3:6])), 1e-300))
    scale, rotation = math.exp(min(max(step[6], -1.0), 1.0)), so3.exp(turn[None])[0]
    return Similarity(scale, rotation, center + length * step[:3] - scale * rotation @ center)


def _with_positions(scene: Scene) -> Scene:
    """Return the scene with control points in place of lines and planes that are measured at a place on them.

    With the whole scene these places move as points do; on a line that moves alone they stay at the foot of an anchor.
    """
    scene = scene.replace(distances=measured_at_positions(scene))
    places, tables = [scene.control_points.xyz], {}
    for name, kinds, column in (("distances", "first_kind", "first_idx"), ("known_planes", "kind", "idx")):
        table = getattr(scene, name)
        kind, index = getattr(table, kinds).copy(), getattr(table, column).copy()
        for of in (Kind.LINE, Kind.PLANE):
            rows = np.flatnonzero(kind == of)
            objects = scene.lines.plucker if of == Kind.LINE else scene.planes.hesse
            places.append(_feet(table.anchor[rows], objects[index[rows]]))
            kind[rows], index[rows] = Kind.CONTROL_POINT, sum(map(len, places[:-1])) + np.arange(len(rows))
        tables[name] = table.replace(**{kinds: kind, column: index})
    new = np.concatenate(places[1:])
    points = scene.control_points.with_unmeasured([f"place {row} on an object" for row in range(len(new))], new)
    return scene.replace(control_points=points, **tables)


def measured_at_positions(scene: Scene) -> Distances:
    """Return the distances, the shortest between two lines as measured where the first is nearest to the second now."""
    table, lines = scene.distances, scene.lines.plucker
    if not (rows := np.flatnonzero(table.is_shortest)).size:
        return table
    anchor = table.anchor.copy()
    anchor[rows] = closest_points(lines[table.first_idx[rows]], lines[table.second_idx[rows]]).first
    return table.replace(anchor=anchor, is_shortest=np.zeros(len(table), bool))


def _feet(places: FloatArray, objects: FloatArray) -> FloatArray:
    """Return the feet (N, 3) of places on lines (N, 6) or planes (N, 4)."""
    if objects.shape[1] == 6:
        return line3.closest_point(objects, places)
    return places - (np.einsum("ni,ni->n", objects[:, :3], places) + objects[:, 3])[:, None] * objects[:, :3]


def _problem(scene: Scene) -> Problem:
    """Return the problem of the measurements alone."""
    options = AssemblyOptions()
    variables = {**camera_variables(scene, options), **structure_variables(scene, options)}
    variables["control_points"] = Variables(Euclidean(3, "point"), scene.control_points.xyz)
    chart = next(iter(LINE_CHARTS.values()))
    variables["lines"] = Variables(chart, chart.from_ambient(scene.lines.plucker))
    draft = Draft(scene, options, variables, [])
    factors = [group.factor for term in _TERMS if term.applies(draft) for group in term.factors(draft)]
    return Problem(variables, factors)


def _normal_equations(problem: Problem, center: FloatArray, length: float) -> tuple[FloatArray, FloatArray]:
    """Return J^T W J (7, 7) and J^T W r (7,) of the seven motions."""
    motions = {name: part.transpose(1, 2, 0) for name, part in world_motions(problem, center, length).items()}
    normal, gradient = np.zeros((7, 7)), np.zeros(7)
    for factor in problem.factors:
        residual, information, weight = weighted(factor, problem)
        J = moved(motions, factor, problem)
        weighed = np.swapaxes(J, 1, 2) @ (weight[:, None, None] * information)
        normal += (weighed @ J).sum(axis=0)
        gradient += np.einsum("nki,ni->k", weighed, residual)
    return normal, gradient


def moved(motions: dict[str, FloatArray], factor: Factor, problem: Problem) -> FloatArray:
    """Return how residuals change with world motions (count, dof, k) of the groups, (N, m, k)."""
    blocks = jacobians_of(factor, problem.variables)
    parts = np.stack([blocks[slot.name] @ motions[ref.group][ref.index] for slot, ref in factor.references()])
    total = parts.sum(axis=0)
    rounding = _ROUNDING * np.abs(parts).sum(axis=0).max(axis=-1, keepdims=True, initial=0.0)
    return np.where(np.abs(total) > rounding, total, 0.0)  # two ends that move as one


def weighted(factor: Factor, problem: Problem) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return residuals (N, m), information (N, m, m) and the weights (N,) that a robust loss left."""
    residual, root = residuals_of(factor, problem.variables), root_matrices(factor)
    information = np.swapaxes(root, 1, 2) @ root
    squares = np.einsum("ni,nij,nj->n", residual, information, residual)
    return residual, information, factor.loss.evaluate(squares)[1]
