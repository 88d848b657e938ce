# SPDX-License-Identifier: BSD-3-Clause
"""Where the two columns meet: a scene becomes a problem, and a solution becomes a scene.

Groups of variables: ``frames`` (rig_from_world), ``sensors`` (cam_from_rig, only in scenes with rigs), one
``intrinsics/MODEL`` per camera model, ``points``, ``lines``, ``planes``, ``directions``.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from groma._counted import counted
from groma._typing import BoolArray, FloatArray, IntArray
from groma.adjustment.terms.relations import MAX_COUPLED_LINES, SURFACE_SIGMA_PX, structure_factors
from groma.adjustment.terms.relations_in_pixels import structure_pixel_factors, wireframe_factors
from groma.cameras import model as camera_model
from groma.errors import InputError
from groma.factors.contract import Factor, Ref
from groma.factors.losses import Loss, Trivial
from groma.factors.observations.line_bearing import LineBearing
from groma.factors.observations.line_reprojection import LineReprojection
from groma.factors.observations.point_reprojection import PointReprojection
from groma.geometry import quaternion, se3
from groma.geometry.algebra import unit
from groma.geometry.charts.line_charts import LINE_CHARTS
from groma.geometry.charts.plane_charts import PLANE_CHARTS
from groma.geometry.charts.point_inverse_depth import InverseDepthPoint
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.geometry.charts.unit3 import DIRECTION_CHARTS
from groma.geometry.manifold import Euclidean
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.scene import Scene

POINT_FACTORS = ("point_reprojection",)
LINE_FACTORS = ("line_reprojection", "line_bearing")
#: A point this many times farther away than its cameras from each other moves linearly in its inverse depth.
FAR_FROM_CAMERAS = 2.0


@dataclass(frozen=True)
class AssemblyOptions:
    """What of a scene takes part, and how it is weighted."""

    #: Points and what was observed of them.
    points: bool = True
    #: Lines and what was observed of them.
    lines: bool = True
    #: Planes and directions; landmarks lie on lines without them too.
    planes: bool = True
    #: Move the cameras; otherwise they are held.
    refine_poses: bool = True
    #: Estimate focal lengths and distortion.
    refine_intrinsics: bool = False
    #: With the intrinsics: principal points too.
    refine_principal_point: bool = False
    #: Estimate where cameras sit on their rig.
    refine_rigs: bool = False
    #: A name of :data:`groma.geometry.charts.line_charts.LINE_CHARTS`.
    line_chart: str = "cartesian"
    #: A name of :data:`groma.geometry.charts.plane_charts.PLANE_CHARTS`.
    plane_chart: str = "normal_offset"
    #: A name of :data:`groma.geometry.charts.pose_charts.POSE_CHARTS`.
    pose_chart: str = "left"
    #: Standard deviation of the usual coordinate of a point, pixels; those of single observations are relative to it.
    point_sigma_px: float = 1.0
    #: The same of an end point of a segment, across it.
    line_sigma_px: float = 1.0
    #: Correlation of the errors of a segment's two ends, across it. Lines are measured where errors are independent:
    #: nearer to the middle of the segment if it is negative, as where a line was fitted to the pixels of an edge.
    line_end_correlation: float = 0.0
    #: How well points and lines keep to their planes and lines, as a length in the images, pixels.
    structure_sigma_px: float = SURFACE_SIGMA_PX
    #: Relations between landmarks as distances (``metric``, weighted by ``structure_sigma_px``) or as differences of
    #: pixels (``pixels``, weighted by the noise of the images).
    structure_form: str = "metric"
    #: Loss of what comes from matching, and of the relations between landmarks.
    loss: Loss = field(default_factory=Trivial)
    #: Leave out points that start behind their camera.
    drop_behind: bool = True
    #: ``free``: damping holds the scene; ``first_camera``: the first frame is held, and the scale by the farthest one;
    #: ``auto``: ``first_camera`` where relations between landmarks are measured in lengths, which would shrink a scene
    #: of free scale, or at the ends of segments, which stay where they are when the scene moves; else ``free``.
    gauge: str = "auto"

    def __post_init__(self) -> None:
        # Here, so that a wrong name is refused whether the scene has such landmarks or not.
        for name, known in (
            ("line_chart", LINE_CHARTS),
            ("plane_chart", PLANE_CHARTS),
            ("pose_chart", POSE_CHARTS),
            ("structure_form", ("metric", "pixels")),
            ("gauge", ("auto", "first_camera", "free")),
        ):
            if getattr(self, name) not in known:
                raise InputError(f"{name} must be one of {', '.join(sorted(known))}; got {getattr(self, name)!r}.")
        if not abs(self.line_end_correlation) < 1.0:
            raise InputError(f"line_end_correlation must be between -1 and 1; got {self.line_end_correlation}.")


@dataclass(frozen=True)
class Assembly:
    """A problem made from a scene, and what was left out."""

    problem: Problem
    #: Sentences about observations that were left out.
    notes: tuple[str, ...]
    #: What a residual of 1 is in the image, pixels, by number of the factor group: 1 unless it is listed here.
    pixels_of_residual: dict[int, FloatArray] = field(default_factory=dict)
    #: How far from the middle of segments lines are measured, in half lengths.
    reach: float = 1.0


def assemble(scene: Scene, options: AssemblyOptions) -> Assembly:
    """Turn a scene into a problem.

    Its groups of variables are ``frames`` (poses), ``sensors`` (where there are rigs), ``intrinsics/MODEL``,
    ``points``, ``lines``, ``planes`` and ``directions``, those that a factor reads.
    """
    notes: list[str] = []
    if options.gauge == "auto":
        wireframe = options.points and options.lines and len(scene.relations.point_on_line) > 0
        metric = (wireframe or (options.planes and len(scene.relations) > 0)) and options.structure_form == "metric"
        ends = options.lines and options.planes and len(scene.relations.line_on_plane) > 0
        options = replace(options, gauge="first_camera" if metric or ends else "free")
    variables = _camera_variables(scene, options)
    factors: list[Factor] = []
    pixels_of_residual: dict[int, FloatArray] = {}
    if options.points and scene.num_point_observations:
        variables["points"] = _point_variables(scene)
        factors += _point_factors(scene, options, notes)
    if options.lines and scene.num_line_observations:
        chart = LINE_CHARTS[options.line_chart]
        variables["lines"] = Variables(chart, chart.from_ambient(scene.lines.plucker))
        for factor, focal in _line_factors(scene, options, notes):
            if focal is not None:
                pixels_of_residual[len(factors)] = focal
            factors.append(factor)
    if options.planes and scene.num_planes:
        chart = PLANE_CHARTS[options.plane_chart]
        variables["planes"] = Variables(chart, chart.from_ambient(scene.planes.hesse))
    if options.planes and scene.num_directions:
        chart = next(iter(DIRECTION_CHARTS.values()))
        variables["directions"] = Variables(chart, chart.from_ambient(scene.directions.vectors))
    sigma_px = (options.point_sigma_px, options.line_sigma_px)
    if options.structure_form == "pixels":
        factors += structure_pixel_factors(scene, sigma_px, options.loss, variables, _camera_refs, _by_model)
    else:
        factors += structure_factors(scene, options.structure_sigma_px, options.loss, variables)
        if {"points", "lines"} <= set(variables) and scene.num_lines > MAX_COUPLED_LINES:
            factors += wireframe_factors(scene, sigma_px, options.loss, _camera_refs, _by_model)
    used = {ref.group for factor in factors for _, ref in factor.references()}
    problem = Problem({k: v for k, v in variables.items() if k in used}, factors)
    return Assembly(problem, tuple(notes), pixels_of_residual, _reach(options))


def disassemble(scene: Scene, problem: Problem) -> Scene:
    """Return the scene with the states of a solved problem."""
    states = {name: group.state for name, group in problem.variables.items()}
    params = scene.cameras.params.copy()
    for name, members in _cameras_by_model(scene).items():
        group = f"intrinsics/{name}"
        if group in states:
            params[members, : states[group].shape[1]] = states[group]
    tables: dict[str, object] = {"cameras": scene.cameras.replace(params=params)}
    if "frames" in states:
        tables["frames"] = scene.frames.replace(rig_from_world=states["frames"])
    if "sensors" in states:
        tables["sensors"] = scene.sensors.replace(cam_from_rig=states["sensors"])
    if "points" in states:
        tables["points"] = scene.points.replace(xyz=problem.variables["points"].ambient())
    if "directions" in states:
        tables["directions"] = scene.directions.replace(vectors=states["directions"])
    scene = scene.replace(**tables)
    if "lines" in states:
        scene = scene.with_lines(problem.variables["lines"].ambient())
    if "planes" in states:
        scene = scene.with_planes(problem.variables["planes"].ambient())
    return scene


def at_places_of(problem: Problem, scene: Scene) -> Problem:
    """Return the problem with frames and landmarks where a scene has them: the same one, its world moved."""
    variables = dict(problem.variables)
    for name in variables.keys() & {"frames", "points", "lines", "planes"}:
        group = variables[name]
        if name == "frames":
            state = scene.frames.rig_from_world
        elif name == "points":
            state = _point_variables(scene).state
        else:
            state = group.manifold.from_ambient(scene.lines.plucker if name == "lines" else scene.planes.hesse)
        variables[name] = group.with_state(state)
    return Problem(variables, problem.factors)


# --------------------------------------------------------------------------------------------------------- cameras


def _cameras_by_model(scene: Scene) -> dict[str, IntArray]:
    models = np.array(scene.cameras.models, dtype=object)
    return {str(name): np.flatnonzero(models == name) for name in dict.fromkeys(models)}


def _camera_variables(scene: Scene, options: AssemblyOptions) -> dict[str, Variables]:
    chart = POSE_CHARTS[options.pose_chart]
    held: bool | BoolArray = not options.refine_poses
    if options.refine_poses and options.gauge == "first_camera":
        held = first_camera_gauge(scene)
    variables = {"frames": Variables(chart, scene.frames.rig_from_world, held)}
    if not scene.has_trivial_rigs:
        constant = (scene.sensors.is_reference == 1) | (not options.refine_rigs)
        variables["sensors"] = Variables(chart, scene.sensors.cam_from_rig, constant)
    for name, members in _cameras_by_model(scene).items():
        model = camera_model(name)
        state = scene.cameras.params[members, : model.num_parameters]
        constant: bool | BoolArray = not options.refine_intrinsics
        if options.refine_intrinsics and model.principal_point_indices and not options.refine_principal_point:
            constant = np.zeros(state.shape, dtype=bool)
            constant[:, list(model.principal_point_indices)] = True
        variables[f"intrinsics/{name}"] = Variables(Euclidean(model.num_parameters, "intrinsics"), state, constant)
    return variables


def first_camera_gauge(scene: Scene) -> BoolArray:
    """Hold the first frame, and of the frame farthest from it the translation along the line between the two.

    Frames with less than half of the usual number of observations are not taken for either: a camera that hardly
    anything holds would leave the scale to relations measured in lengths, which shrink the scene.
    """
    poses = scene.frames.rig_from_world
    held = np.zeros((len(poses), 6), dtype=bool)
    if len(poses) == 0:
        return held
    frame_of = scene.images.frame_idx
    seen = [table.image_idx for table in (scene.point_observations, scene.line_observations)]
    count = np.bincount(frame_of[np.concatenate(seen)], minlength=len(poses))
    fit = np.flatnonzero(count >= 0.5 * np.median(count))
    first = int(fit[0])
    held[first] = True
    centers = se3.inverse(poses)[:, 4:]
    away = centers - centers[first]
    far = int(fit[np.argmax(np.linalg.norm(away[fit], axis=1))])
    if far != first:
        in_camera = quaternion.rotate(poses[far, :4], away[far])
        held[far, int(np.argmax(np.abs(in_camera)))] = True
    return held


def _camera_refs(scene: Scene, image_idx: IntArray) -> dict[str, Ref]:
    refs = {"pose": Ref("frames", scene.images.frame_idx[image_idx])}
    if not scene.has_trivial_rigs:
        refs["extrinsics"] = Ref("sensors", scene.images.sensor_idx[image_idx])
    return refs


def _by_model(scene: Scene, image_idx: IntArray):
    """Yield (model name, rows of the observations, index of each one's camera in the model's group)."""
    camera_of = scene.images.camera_idx[image_idx]
    for name, members in _cameras_by_model(scene).items():
        position = np.full(len(scene.cameras), -1)
        position[members] = np.arange(len(members))
        rows = np.flatnonzero(position[camera_of] >= 0)
        if len(rows):
            yield name, rows, position[camera_of[rows]]


# ------------------------------------------------------------------------------------------------------- landmarks


def _point_variables(scene: Scene) -> Variables:
    """Points; those far from their cameras move linearly in the inverse of their distance from the cameras' mean."""
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


def _point_factors(scene: Scene, options: AssemblyOptions, notes: list[str]) -> list[Factor]:
    table = scene.point_observations
    keep = np.ones(len(table), dtype=bool)
    if options.drop_behind:
        row = se3.to_matrix(scene.cam_from_world)[:, 2].take(table.image_idx, axis=0)
        depth = np.einsum("ni,ni->n", row[:, :3], scene.points.xyz.take(table.point_idx, axis=0)) + row[:, 3]
        sees_behind = np.array([camera_model(name).sees_behind for name in scene.cameras.models])
        keep = (depth > 0) | sees_behind[scene.images.camera_idx][table.image_idx]
        if not keep.all():
            notes.append(f"Left out: {counted(int((~keep).sum()), 'observations')} of points behind their camera.")
    table = table.take(np.flatnonzero(keep)) if not keep.all() else table
    factors: list[Factor] = []
    for name, rows, camera in _by_model(scene, table.image_idx):
        factors.append(
            PointReprojection(
                camera_model=name,
                point=Ref("points", table.point_idx[rows]),
                intrinsics=Ref(f"intrinsics/{name}", camera),
                pixels=table.pixel.take(rows, axis=0),
                require_in_front=False,
                sqrt_information=1.0 / (options.point_sigma_px * table.sigma[rows]),
                loss=options.loss,
                **_camera_refs(scene, table.image_idx[rows]),
            )
        )
    return factors


def _line_factors(scene: Scene, options: AssemblyOptions, notes: list[str]):
    """Yield factors of lines, and the pixels of a residual of 1 where it is not measured in pixels."""
    table, reach = scene.line_observations, _reach(options)
    sigma = options.line_sigma_px * np.sqrt(1.0 + options.line_end_correlation) * table.sigma
    for name, rows, camera in _by_model(scene, table.image_idx):
        model = camera_model(name)
        line = Ref("lines", table.line_idx[rows])
        poses = _camera_refs(scene, table.image_idx[rows])
        if model.has_pinhole_parameters:
            in_pixels = LineReprojection(
                camera_model=name,
                line=line,
                intrinsics=Ref(f"intrinsics/{name}", camera),
                segments=np.hstack(_nearer(table.segment[rows, :2], table.segment[rows, 2:], reach)),
                sqrt_information=1.0 / sigma[rows],
                loss=options.loss,
                **poses,
            )
            yield in_pixels, None
            continue
        params = scene.cameras.params[scene.images.camera_idx[table.image_idx[rows]], : model.num_parameters]
        first = model.unproject(params, table.segment[rows, :2])
        second = model.unproject(params, table.segment[rows, 2:])
        good = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
        if not good.all():
            notes.append(f"Left out: {counted(int((~good).sum()), 'segments')} outside the range of the {name} model.")
        focal = params[:, list(model.focal_indices)].mean(axis=1)
        kept = rows[good]
        first, second = _nearer(first[good], second[good], reach)
        if reach != 1.0:
            first, second = unit(first), unit(second)
        in_radians = LineBearing(
            line=Ref("lines", table.line_idx[kept]),
            start_bearings=first,
            end_bearings=second,
            sqrt_information=focal[good] / sigma[kept],
            loss=options.loss,
            **_camera_refs(scene, table.image_idx[kept]),
        )
        yield in_radians, focal[good]


def _reach(options: AssemblyOptions) -> float:
    r"""Where on a segment, from its middle in half lengths, errors are independent.

    The mean of the two ends' errors has the variance :math:`(1+\rho)\sigma^2/2` and half of their difference
    :math:`(1-\rho)\sigma^2/2`, independent of each other; so at :math:`\pm s` with
    :math:`s^2 = (1+\rho)/(1-\rho)` errors are independent too, of the variance :math:`(1+\rho)\sigma^2`. A line fitted
    to many pixels has :math:`\rho = -1/2`: its places are those of the quadrature of Gauss.
    """
    return float(np.sqrt((1.0 + options.line_end_correlation) / (1.0 - options.line_end_correlation)))


def _nearer(first: FloatArray, second: FloatArray, reach: float) -> tuple[FloatArray, FloatArray]:
    """The two places on segments that are so far from their middles, in half lengths."""
    if reach == 1.0:
        return first, second
    middle, half = 0.5 * (first + second), 0.5 * reach * (second - first)
    return middle - half, middle + half
