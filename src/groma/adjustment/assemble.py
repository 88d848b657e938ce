# SPDX-License-Identifier: BSD-3-Clause
"""Where the two columns meet: a scene becomes a problem, and a solution becomes a scene.

Every factor of an adjustment, of a map and of a track is made here, by the terms of :data:`TERMS`, one for each kind of
measurement.

Groups of variables: ``frames`` (rig_from_world), ``sensors`` (cam_from_rig, only in scenes with rigs), one
``intrinsics/MODEL`` per camera model, ``motions`` (only with rolling shutters), ``points``, ``lines``, ``planes``,
``directions``, ``control_points``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.terms import (
    camera_motions,
    camera_poses,
    control_points,
    distances,
    known_geometry,
    line_depths,
    lines,
    plane_observations,
    point_depths,
    points,
    principal_points,
    relations,
    relations_in_pixels,
    right_columns,
)
from groma.adjustment.terms.contract import Draft, Group, Term
from groma.adjustment.terms.objects import with_held
from groma.adjustment.terms.open_motions import coordinates_to_hold
from groma.adjustment.terms.readout import MOTIONS
from groma.cameras import model as camera_model
from groma.errors import check_kind
from groma.geometry import quaternion, se3
from groma.geometry.charts.line_charts import LINE_CHARTS
from groma.geometry.charts.plane_charts import PLANE_CHARTS
from groma.geometry.charts.point_inverse_depth import InverseDepthPoint
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.geometry.charts.unit3 import DIRECTION_CHARTS
from groma.geometry.manifold import Euclidean
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.scene import Scene
from groma.scene.checks import check_scene_given
from groma.scene.survey import accepted

#: The kinds of measurements, in the order of their factors.
TERMS: tuple[Term, ...] = (
    points.TERM,
    right_columns.TERM,
    point_depths.TERM,
    lines.TERM,
    line_depths.TERM,
    plane_observations.TERM,
    relations.TERM,
    relations_in_pixels.TERM,
    camera_poses.PRIORS,
    camera_poses.HELD_SCALE,
    principal_points.TERM,
    camera_motions.TERM,
    camera_poses.POSITIONS,
    camera_poses.POSES,
    control_points.MARKS,
    control_points.CONTROL,
    distances.TERM,
    known_geometry.PLANES,
    known_geometry.DIRECTIONS,
)
#: Types of factors that are observations of points in images.
POINT_FACTORS = ("point_reprojection", "stereo_point")
#: Columns of the scene that groups of variables of the same name hold as they are.
COLUMNS = {"frames": "rig_from_world", "sensors": "cam_from_rig", "control_points": "xyz", "directions": "vectors"}
#: A point this many times farther away than its cameras from each other moves linearly in its inverse depth.
FAR_FROM_CAMERAS = 2.0


@dataclass(frozen=True)
class Assembly:
    """A problem made from a scene, and what was left out."""

    problem: Problem
    #: Sentences about observations that were left out.
    notes: tuple[str, ...]
    #: The origins of the factors, in their order: names of terms, with what a term records about each.
    terms: tuple[str, ...] = ()
    groups: tuple[Group, ...] = ()
    #: How far from the middle of segments lines are measured, in half lengths.
    reach: float = 1.0

    @property
    def num_measurements(self) -> dict[str, int]:
        """Numbers of factors by term, in order."""
        count: dict[str, int] = {}
        for name, group in zip(self.terms, self.groups, strict=True):
            count[name] = count.get(name, 0) + len(group.factor)
        return count


def assemble(scene: Scene, options: AssemblyOptions, more: Sequence[Term] = ()) -> Assembly:
    """Turn a scene into a problem.

    Its groups of variables are ``frames`` (poses), ``sensors`` (where there are rigs), ``intrinsics/MODEL``,
    ``points``, ``lines``, ``planes`` and ``directions``, those that a factor reads, and what terms add.

    Parameters
    ----------
    scene : Scene
        Cameras, landmarks and measurements.
    options : AssemblyOptions
        What of them takes part.
    more : sequence of Term
        Kinds of measurements besides :data:`TERMS`.
    """
    notes: list[str] = []
    check_scene_given(scene)
    check_kind(options, AssemblyOptions, "options", "Make one: AssemblyOptions(...).")
    scene = accepted(scene)
    if options.gauge == "auto":
        options = replace(options, gauge=gauge_of(scene, options))
    variables = {**camera_variables(scene, options), **_landmark_variables(scene, options)}
    variables = with_held({**variables, **structure_variables(scene, options)}, scene)
    draft = Draft(scene, options, variables, notes)
    made = [(term.name, group) for term in (*TERMS, *more) if term.applies(draft) for group in term.factors(draft)]
    factors = [group.factor for _, group in made]
    used = {ref.group for factor in factors for _, ref in factor.references()}
    problem = Problem({k: v for k, v in draft.variables.items() if k in used}, factors)
    names, groups = tuple(name for name, _ in made), tuple(group for _, group in made)
    return Assembly(problem, tuple(notes), names, groups, options.reach)


def gauge_of(scene: Scene, options: AssemblyOptions) -> str:
    """Whether the first frame must be held; see :attr:`AssemblyOptions.gauge`."""
    if len(scene.pose_priors) or scene.is_surveyed:
        return "free"
    if scene.is_tied:
        return "first_camera"  # of what measurements leave open
    wireframe = options.points and options.lines and len(scene.relations.point_on_line) > 0
    metric = (wireframe or (options.planes and len(scene.relations) > 0)) and options.structure_form == "metric"
    ends = options.lines and options.planes and len(scene.relations.line_on_plane) > 0
    lengths = scene.is_metric or len(scene.camera_motions) > 0
    return "first_camera" if metric or ends or lengths else "free"


def disassemble(scene: Scene, problem: Problem) -> Scene:
    """Return the scene with the states of a solved problem."""
    check_scene_given(scene)
    check_kind(problem, Problem, "problem", "Make one: assemble(scene, options).")
    states = {name: group.state for name, group in problem.variables.items()}
    params = scene.cameras.params.copy()
    for name, members in scene.cameras.by_model().items():
        group = f"intrinsics/{name}"
        if group in states:
            params[members, : states[group].shape[1]] = states[group]
    tables: dict[str, object] = {"cameras": scene.cameras.replace(params=params)}
    for name, column in COLUMNS.items():
        if name in states:
            tables[name] = getattr(scene, name).replace(**{column: states[name]})
    if MOTIONS in states:
        tables["camera_motions"] = scene.camera_motions.replace(motion=states[MOTIONS][:-1])
    if "points" in states:
        tables["points"] = scene.points.replace(xyz=problem.variables["points"].ambient())
    scene = scene.replace(**tables)
    if "lines" in states:
        scene = scene.with_lines(problem.variables["lines"].ambient())
    if "planes" in states:
        scene = scene.with_planes(problem.variables["planes"].ambient())
    return scene


# --------------------------------------------------------------------------------------------------------- cameras


def camera_variables(scene: Scene, options: AssemblyOptions, gauge: BoolArray | None = None) -> dict[str, Variables]:
    """Return the groups of frames, sensors and intrinsics, and what of them is held.

    Parameters
    ----------
    scene, options
        Cameras, and what of them moves.
    gauge : (F, 6) bool, optional
        What ``first_camera`` holds, where the scene is one part of a whole; else :func:`first_camera_gauge`.
    """
    chart = POSE_CHARTS["left"]
    held: bool | BoolArray = not options.refine_poses
    if options.refine_poses and options.gauge == "first_camera":
        held = first_camera_gauge(scene) if gauge is None else gauge
    if options.refine_poses and options.held_frames is not None:
        held = options.held_frames if isinstance(held, bool) else held | options.held_frames[:, None]
    variables = {"frames": Variables(chart, scene.frames.rig_from_world, held)}
    if not scene.has_trivial_rigs:
        constant = (scene.sensors.is_reference == 1) | (not options.refine_rigs)
        variables["sensors"] = Variables(chart, scene.sensors.cam_from_rig, constant)
    if len(scene.camera_motions):
        variables[MOTIONS] = camera_motions.motion_variables(scene, options.refine_poses)
    by_prior = principal_points.estimated_by_prior(scene, options)
    free = by_prior if options.refine_intrinsics is None else np.full(len(by_prior), options.refine_intrinsics)
    for name, members in scene.cameras.by_model().items():
        model = camera_model(name)
        state = scene.cameras.params[members, : model.num_parameters]
        kept = np.repeat(~free[members, None], model.num_parameters, axis=1)
        kept[:, model.known_indices] = True
        if not options.refine_principal_point:
            kept[:, model.principal_point_indices] |= ~by_prior[members, None]
        constant: bool | BoolArray = bool(kept.all()) or (kept if kept.any() else False)
        variables[f"intrinsics/{name}"] = Variables(Euclidean(model.num_parameters, "intrinsics"), state, constant)
    return variables


def observations_of_frames(scene: Scene) -> IntArray:
    """Return how many points and lines were observed in each frame, (F,)."""
    seen = [table.image_idx for table in (scene.point_observations, scene.line_observations)]
    return np.bincount(scene.images.frame_idx[np.concatenate(seen)], minlength=scene.num_frames)


def first_camera_gauge(
    scene: Scene, count: IntArray | None = None, is_metric: bool | None = None, first: int | None = None
) -> BoolArray:
    """Hold the first frame, or a given one, and of the frame farthest from it the translation along the line between
    the two; this unless measurements determine the scale.

    Where other instruments measured something, only what they leave open is held.

    Frames with less than half of the usual number of observations are not taken for either: a camera that hardly
    anything holds would leave the scale to relations measured in lengths, which shrink the scene.

    Parameters
    ----------
    scene : Scene
        The poses.
    count, is_metric : (F,) int, bool, optional
        Observations of each frame, and whether measurements determine the scale; by default those of the scene.
    first : int, optional
        The frame that is held; by default the first with half of the usual number of observations.
    """
    scene, poses = accepted(scene), scene.frames.rig_from_world
    held = np.zeros((len(poses), 6), dtype=bool)
    if len(poses) == 0:
        return held
    count = observations_of_frames(scene) if count is None else count
    fit = np.flatnonzero(count >= 0.5 * np.median(count))
    if scene.is_tied:
        return coordinates_to_hold(scene, count >= 0.5 * np.median(count))
    first = int(fit[0]) if first is None else first
    held[first] = True
    centers = se3.inverse(poses)[:, 4:]
    away = centers - centers[first]
    far = int(fit[np.argmax(np.linalg.norm(away[fit], axis=1))])
    if far != first and not (scene.has_scale if is_metric is None else is_metric):
        in_camera = quaternion.rotate(poses[far, :4], away[far])
        held[far, int(np.argmax(np.abs(in_camera)))] = True
    return held


# ------------------------------------------------------------------------------------------------------- landmarks


def _landmark_variables(scene: Scene, options: AssemblyOptions) -> dict[str, Variables]:
    """Return the groups of points and lines, if they take part; terms use what they need."""
    variables = {}
    if options.points and (scene.num_point_observations or len(scene.point_depths)):
        variables["points"] = point_variables(scene, options.point_chart)
    variables |= control_point_variables(scene, options)
    if options.lines and scene.num_line_observations:
        chart = LINE_CHARTS[options.line_chart]
        variables["lines"] = Variables(chart, chart.from_ambient(scene.lines.plucker))
    return variables if options.refine_landmarks else _held(variables)


def control_point_variables(scene: Scene, options: AssemblyOptions) -> dict[str, Variables]:
    """Return the group of control points, if any was marked."""
    if not len(scene.marks):
        return {}
    group = Variables(Euclidean(3, "point"), scene.control_points.xyz)
    return {"control_points": group if options.refine_landmarks else replace(group, constant=True)}


def structure_variables(scene: Scene, options: AssemblyOptions) -> dict[str, Variables]:
    """Return the groups of planes and directions, if they take part."""
    variables = {}
    if options.planes and scene.num_planes:
        chart = PLANE_CHARTS["normal_offset"]
        variables["planes"] = Variables(chart, chart.from_ambient(scene.planes.hesse))
    if options.planes and scene.num_directions:
        chart = next(iter(DIRECTION_CHARTS.values()))
        variables["directions"] = Variables(chart, chart.from_ambient(scene.directions.vectors))
    return variables if options.refine_landmarks else _held(variables)


def _held(variables: dict[str, Variables]) -> dict[str, Variables]:
    return {name: replace(group, constant=True) for name, group in variables.items()}


def point_variables(scene: Scene, chart_name: str = "auto") -> Variables:
    """Points; those far from their cameras move linearly in the inverse of their distance from the cameras' mean."""
    if chart_name == "euclidean":
        return Variables(Euclidean(3, "point"), scene.points.xyz)
    table = scene.point_observations
    count = np.maximum(np.bincount(table.point_idx, minlength=scene.num_points), 1)

    def mean(values: FloatArray) -> FloatArray:
        return np.bincount(table.point_idx, weights=values, minlength=scene.num_points) / count

    centers = scene.cam_centers_in_world
    anchor = np.stack([mean(column.take(table.image_idx)) for column in centers.T], axis=1)
    away = centers.take(table.image_idx, axis=0) - anchor.take(table.point_idx, axis=0)
    spread = np.sqrt(mean(np.einsum("ni,ni->n", away, away)))
    far = np.linalg.norm(scene.points.xyz - anchor, axis=1) > FAR_FROM_CAMERAS * spread
    chart = InverseDepthPoint()
    return Variables(chart, chart.anchored(scene.points.xyz, anchor, far.astype(np.float64)))
