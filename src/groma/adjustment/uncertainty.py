# SPDX-License-Identifier: BSD-3-Clause
"""How certain the parts of an adjusted scene are, in the terms of the scene."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.adjustment.assemble import assemble, first_camera_gauge
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.moved_problem import problem_at
from groma.adjustment.terms.camera_poses import held_scale
from groma.adjustment.terms.objects import with_held
from groma.adjustment.terms.principal_points import with_principal_points_known_to
from groma.errors import InputError, ProblemError, check_kind
from groma.geometry import so3
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.scene import Scene
from groma.scene.checks import check_scene_given
from groma.scene.local_frame import local_frame
from groma.solver.covariance.marginals import Covariances
from groma.solver.covariance.released import released


@dataclass(frozen=True)
class SceneUncertainty:
    """Covariances of a scene; NaN: unobservable, zero: held."""

    #: Frame that the covariances refer to: ``inner``, ``held`` or ``measured``.
    gauge: str
    #: Standard deviation of unit weight that they are scaled by.
    sigma0: float
    #: (F, 6, 6) of the frames' poses: left twist, shift before turn (radians), in the camera or rig frame.
    poses: FloatArray
    #: (F, 3, 3) of the frames' centres in the world, scene units squared.
    centers: FloatArray
    #: (P, 3, 3) of the points, scene units squared.
    points: FloatArray
    #: (L, 6, 6) of (m, d) of the lines with a unit direction.
    lines: FloatArray
    #: (L, 2, 3, 3) of the end points of the segments across their line; along it an end is where the images end.
    segment_ends: FloatArray
    #: (K, 4, 4) of (n, w) of the planes with a unit normal.
    planes: FloatArray
    #: (D, 3, 3) of the directions.
    directions: FloatArray
    #: Identifiers of unobservable landmarks, by kind: ``points``, ``lines``, ``planes``, ``directions``, and the rows
    #: of ``frames``. Their covariances are NaN, and all others are not affected.
    undetermined: dict[str, IntArray]
    #: For joint covariances and derived quantities: groups are ``frames``, ``points``, ``lines``, ``planes``. Of a
    #: scene far from the origin they are in :func:`groma.scene.local_frame.local_frame`.
    covariances: Covariances

    def to_dict(self) -> dict[str, Any]:
        """Return medians and worst cases of the standard deviations as plain numbers, for JSON."""
        turn = np.sqrt(np.einsum("nii->n", self.poses[:, 3:, 3:]))
        return {
            "gauge": self.gauge,
            "sigma0": self.sigma0,
            "center": _summary(position_sigma(self.centers)),
            "rotation_deg": _summary(np.rad2deg(turn)),
            "point": _summary(position_sigma(self.points)),
            "segment_end": _summary(position_sigma(self.segment_ends.reshape(-1, 3, 3))),
            "line_direction_deg": _summary(np.rad2deg(position_sigma(self.lines[:, 3:, 3:]))),
            "plane_normal_deg": _summary(np.rad2deg(position_sigma(self.planes[:, :3, :3]))),
            "undetermined": {kind: ids.tolist() for kind, ids in self.undetermined.items()},
        }


def position_sigma(covariance: FloatArray) -> FloatArray:
    """Root of the summed variances (N,) of vectors with covariances (N, m, m)."""
    return np.sqrt(np.maximum(np.einsum("nii->n", covariance), 0.0))


def uncertainty(
    scene: Scene,
    options: AssemblyOptions | None = None,
    gauge: str = "auto",
    sigma0: float = 1.0,
    problem: Problem | None = None,
) -> SceneUncertainty:
    """Return the covariances of an adjusted scene.

    Parameters
    ----------
    scene : Scene
        At its minimum.
    options : AssemblyOptions, optional
        The noise and the losses it was adjusted with; ``gauge`` in it is overridden.
    gauge : str
        ``inner``: a free network; the camera centres vary least together. ``held``: the first camera and the scale are
        certain. ``auto``: inner, or held where lengths in the cameras or between landmarks tie the scale; where
        other instruments say where the scene is, ``measured``: covariances are of their frame, and of what they leave
        open inner.
    sigma0 : float
        Covariances are multiplied by its square; pass the root of the report's ``reduced_chi_square`` where the stated
        noise is not credible.
    problem : Problem, optional
        The problem already made from the scene, at its solution. For ``inner`` its frames are freed; for ``held`` the
        first camera and the scale are held unless the problem has held variables.

    Returns
    -------
    SceneUncertainty
        In scene units and radians.

    Raises
    ------
    InputError
        If the gauge is not known.
    ProblemError
        If the poses are not determined; see :func:`groma.adjustment.diagnosis.diagnose_scene`. Landmarks may be
        unobservable.
    """
    check_scene_given(scene)
    if gauge not in ("auto", "inner", "held"):
        raise InputError(f"gauge must be 'auto', 'inner' or 'held'; got {gauge!r}.")
    options = AssemblyOptions(refine_intrinsics=None, refine_principal_point=None) if options is None else options
    check_kind(options, AssemblyOptions, "options", "Make one: AssemblyOptions(...), or leave it out.")
    near = local_frame(scene)
    if near is None:
        return _uncertainty(scene, options, gauge, sigma0, problem)
    moved = scene.transformed(near)
    found = _uncertainty(moved, options, gauge, sigma0, None if problem is None else problem_at(problem, moved))
    lines, planes = np.eye(6), np.eye(4)
    lines[:3, 3:], planes[3, :3] = so3.hat(-near.translation), near.translation
    return replace(found, lines=lines @ found.lines @ lines.T, planes=planes @ found.planes @ planes.T)


def _uncertainty(
    scene: Scene, options: AssemblyOptions, gauge: str, sigma0: float, problem: Problem | None
) -> SceneUncertainty:
    """Return the covariances of a scene that is near the origin of its world."""
    gauge, covariances = _covariances(scene, options, gauge, problem, sigma0)
    problem, factor = covariances.problem, sigma0**2

    def coordinates(name: str, size: int, count: int) -> FloatArray:
        if name not in problem.variables:
            return np.full((count, size, size), np.nan)
        return covariances.of_coordinates(name) * factor

    poses = coordinates("frames", 6, scene.num_frames)
    shift = poses[:, :3, :3]
    rotation = problem.variables["frames"].ambient().reshape(-1, 3, 4)[:, :, :3]
    lines = coordinates("lines", 6, scene.num_lines)
    if "lines" in problem.variables:
        plucker = problem.variables["lines"].ambient()
        size = np.linalg.norm(plucker[:, 3:], axis=1)
        lines = _unit_direction(plucker, lines, slice(3, 6)) / size[:, None, None] ** 2
    planes = coordinates("planes", 4, scene.num_planes)
    if "planes" in problem.variables:
        hesse = problem.variables["planes"].ambient()
        size = np.linalg.norm(hesse[:, :3], axis=1)
        planes = _unit_direction(hesse, planes, slice(0, 3)) / size[:, None, None] ** 2
    return SceneUncertainty(
        gauge=gauge,
        sigma0=sigma0,
        poses=poses,
        centers=np.swapaxes(rotation, 1, 2) @ shift @ rotation,
        points=coordinates("points", 3, scene.num_points),
        lines=lines,
        segment_ends=_ends(scene, lines),
        planes=planes,
        directions=coordinates("directions", 3, scene.num_directions),
        undetermined=_undetermined(covariances, scene),
        covariances=covariances,
    )


def pose_uncertainty(
    scene: Scene, problem: Problem, sigma0: float = 1.0, gauge: str = "auto", by_landmarks: bool = False
) -> dict[str, Any] | None:
    """Return how well the cameras alone are known: ``gauge``, ``sigma0``, ``center`` and ``rotation_deg``.

    The entries are those of :meth:`SceneUncertainty.to_dict`; for the parameters see :func:`uncertainty`. None where
    all cameras are held. Where the covariances cannot be computed the entry ``why_not`` says the reason, and there are
    no deviations. ``calibration`` says how much of it counts as exact: ``all``, ``part`` or ``none``. ``by_landmarks``
    multiplies the deviations, in place of by ``sigma0``, by what leaving out one landmark after the other tells
    (:mod:`groma.adjustment.misfit.jackknife`); the entry ``factor`` is the median of that. Not where other instruments
    measured the frame: landmarks do not tell how well they did.
    """
    by_landmarks = by_landmarks and not scene.is_tied
    if "frames" not in problem.variables or _free_cameras(problem) == 0:
        return None
    near = local_frame(scene)
    if near is not None:
        scene = scene.transformed(near)
        problem = problem_at(problem, scene)
    try:
        gauge, covariances = _covariances(scene, AssemblyOptions(), gauge, problem, 1.0 if by_landmarks else sigma0)
        poses = covariances.of_coordinates("frames") * (1.0 if by_landmarks else sigma0**2)
        factors = _landmark_factors(scene, covariances.problem, gauge) if by_landmarks else None
    except ProblemError as error:
        none = _summary(np.full(_free_cameras(problem), np.nan))
        return {"gauge": None, "sigma0": sigma0, "center": none, "rotation_deg": none, "why_not": str(error)}
    center, turn = position_sigma(poses[:, :3, :3]), position_sigma(poses[:, 3:, 3:])
    found: dict[str, Any] = {"gauge": gauge, "sigma0": sigma0, "calibration": _exact_calibration(problem)}
    if factors is not None:
        center, turn = center * factors[:, 0], turn * factors[:, 1]
        found["factor"] = float(np.median(factors))
    return {**found, "center": _summary(center), "rotation_deg": _summary(np.rad2deg(turn))}


def _exact_calibration(problem: Problem) -> str:
    """How much of the calibration is held, so that its errors are in no deviation: ``all``, ``part`` or ``none``."""
    groups = [group for group in problem.variables.values() if group.manifold.kind == "intrinsics"]
    free = [np.ones(1, bool) if (part := group.free_coordinates()) is None else part for group in groups]
    if not any(part.any() for part in free):
        return "all"
    return "none" if all(part.all() for part in free) else "part"


def _landmark_factors(scene: Scene, problem: Problem, gauge: str) -> FloatArray:
    """Return the factors (F, 2) by which leaving out landmarks one by one enlarges the deviations of each frame.

    The first is that of the centre, the second that of the rotation.
    """
    from groma.adjustment.misfit.jackknife import landmark_jackknife, observations_alone

    covariances = _covariances(scene, AssemblyOptions(planes=False), gauge, observations_alone(problem))[1]
    stated, found = landmark_jackknife(covariances)
    sigma = [
        np.column_stack([position_sigma(one[:, :3, :3]), position_sigma(one[:, 3:, 3:])]) for one in (stated, found)
    ]
    return np.divide(sigma[1], sigma[0], out=np.ones_like(sigma[0]), where=sigma[0] > 0.0)


def _covariances(
    scene: Scene, options: AssemblyOptions, gauge: str, problem: Problem | None, sigma0: float = 1.0
) -> tuple[str, Covariances]:
    """Return the gauge that was chosen, and the covariances in it, which the caller multiplies by ``sigma0`` squared.

    What is known of lenses beforehand does not depend on the noise, and is divided by that square here.
    """
    if gauge == "auto" and scene.is_tied:
        gauge = "measured"
    elif gauge == "auto":
        metric = options.planes and len(scene.relations) > 0 and options.structure_form == "metric"
        gauge = "held" if metric or scene.is_metric or len(scene.camera_motions) else "inner"
    if problem is None:
        held = "first_camera" if gauge == "held" else "free"
        problem = assemble(scene, replace(options, gauge=held)).problem
    else:
        problem = _in_gauge(problem, scene, "inner" if gauge == "measured" else gauge)
    problem = with_principal_points_known_to(problem, 1.0 / sigma0)
    if gauge == "measured":
        with suppress(ProblemError):
            return gauge, measured_covariances(problem)
        gauge = "inner"
    datum = {"frames": [1, 1, 1, 0, 0, 0]} if gauge == "inner" and _free_cameras(problem) > 2 else None
    return gauge, Covariances(problem, gauge=gauge, datum=datum)


def measured_covariances(problem: Problem) -> Covariances:
    """Return covariances in the frame that measurements determine; a held scale is as uncertain as they leave it."""
    covariances, held = Covariances(problem), held_scale(problem)
    return covariances if held is None else released(covariances, held)


def _summary(values: FloatArray) -> dict[str, Any]:
    finite = values[np.isfinite(values)]
    return {
        "median": float(np.median(finite)) if len(finite) else None,
        "largest": float(finite.max()) if len(finite) else None,
        "undetermined": int((~np.isfinite(values)).sum()),
    }


def _undetermined(covariances: Covariances, scene: Scene) -> dict[str, IntArray]:
    ids = {
        "frames": np.arange(scene.num_frames),
        "points": scene.points.ids,
        "lines": scene.lines.ids,
        "planes": scene.planes.ids,
        "directions": scene.directions.ids,
    }
    present = covariances.problem.variables
    return {name: numbers[covariances.undetermined(name)] for name, numbers in ids.items() if name in present}


def _in_gauge(problem: Problem, scene: Scene, gauge: str) -> Problem:
    """Return the problem with free frames, or with the first one and the scale held if nothing is held yet."""
    frames = problem.variables["frames"]
    free = frames.free_coordinates()
    if _free_cameras(problem) == 0 or (free is None) == (gauge == "inner"):
        return problem
    constant = first_camera_gauge(scene) if gauge == "held" else False
    variables = {**problem.variables, "frames": Variables(frames.manifold, frames.state, constant)}
    return Problem(with_held(variables, scene), problem.factors)


def _free_cameras(problem: Problem) -> int:
    group = problem.variables["frames"]
    free = group.free_coordinates()
    return len(group) if free is None else int(free.any(axis=1).sum())


def _unit_direction(ambient: FloatArray, covariance: FloatArray, part: slice) -> FloatArray:
    """Covariance of homogeneous numbers whose part is kept at its length: P Sigma P^T."""
    u = ambient[:, part] / np.linalg.norm(ambient[:, part], axis=1, keepdims=True)
    lead = np.zeros_like(ambient)
    lead[:, part] = u
    scale = np.linalg.norm(ambient[:, part], axis=1, keepdims=True)
    P = np.eye(ambient.shape[1]) - (ambient / scale)[:, :, None] * lead[:, None, :]
    return P @ covariance @ np.swapaxes(P, 1, 2)


def _ends(scene: Scene, lines: FloatArray) -> FloatArray:
    """Covariance (L, 2, 3, 3) of the segment ends across their lines: X moves by d x (dm - X x dd)."""
    d = scene.lines.segments[:, 1] - scene.lines.segments[:, 0]
    d = d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-300)
    out = np.empty((len(d), 2, 3, 3))
    across = so3.hat(d)
    for k in range(2):
        J = np.concatenate([across, -across @ so3.hat(scene.lines.segments[:, k])], axis=2)
        out[:, k] = J @ lines @ np.swapaxes(J, 1, 2)
    return out
