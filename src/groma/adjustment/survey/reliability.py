# SPDX-License-Identifier: BSD-3-Clause
r"""How well each measurement is checked by all others, and which of them are wrong.

Let a measurement of m coordinates have the covariance C, its residual v (computed less measured) and
:math:`S = J \Sigma_x J^\top` the covariance that the adjusted scene has there. A robust loss gave it the weight
:math:`\omega C^{-1}`. Had it not taken part, residual and covariance would be

.. math:: v_- = (I - \omega S C^{-1})^{-1} v, \qquad S_- = (I - \omega S C^{-1})^{-1} S ,

and at full weight :math:`v_+ = (I + S_- C^{-1})^{-1} v_-` and :math:`Q_v = C - (I + S_- C^{-1})^{-1} S_-`. A point
that a single image shows has no place without its coordinates, so the two are computed without that detour:

.. math:: F = (I + (1 - \omega) S C^{-1})^{-1}, \qquad v_+ = F v, \qquad Q_v = C - F S .

From them follow, for each coordinate i, with :math:`P = C^{-1}`,

.. math:: r_i = (Q_v P)_{ii}, \qquad w_i = \frac{(P v_+)_i}{\sqrt{(P Q_v P)_{ii}}}, \qquad
          \nabla_i = \frac{\delta_0}{\sqrt{(P Q_v P)_{ii}}},

the redundancy number (1: checked fully, 0: not at all), the normalised residual (standard normal without gross
errors), and the error that a test at the level :math:`\alpha` finds with the power :math:`1 - \beta`. For C diagonal
these are :math:`w_i = v_i / (\sigma_i \sqrt{r_i})` and :math:`\nabla_i = \delta_0 \sigma_i / \sqrt{r_i}`. The sum of
:math:`v_+^\top P v_+` over that of r is the variance component of a kind: 1 where standard deviations are right.
What was rejected before took part with :math:`\omega = 0` and is tested by the same formulas.

References
----------
Baarda, *A testing procedure for use in geodetic networks*, 1968; Foerstner, *Reliability analysis of parameter
estimation in linear models*, 1987; Foerstner and Wrobel, *Photogrammetric computer vision*, 2016, section 4.6.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import scipy  # its parts are imported when something of them is first used

from groma._typing import FloatArray, IntArray
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.moved_problem import problem_at
from groma.adjustment.survey.best_fit import moved, weighted
from groma.adjustment.survey.records import (
    GATES,
    TABLES,
    CheckPoint,
    Measurement,
    Reliability,
    gross_errors,
    noncentrality,
)
from groma.adjustment.terms import camera_poses, control_points, distances, known_geometry
from groma.adjustment.terms.contract import Draft
from groma.adjustment.terms.objects import name_of, rows_by_kind
from groma.adjustment.uncertainty import measured_covariances
from groma.errors import ProblemError
from groma.factors.contract import Factor
from groma.factors.losses import Trivial
from groma.gates import NORMAL
from groma.problem.gauge import world_motions
from groma.problem.problem import Problem
from groma.problem.residuals import jacobians_of
from groma.problem.variables import Variables
from groma.scene import Scene
from groma.scene.checks import check_scene_given
from groma.scene.local_frame import local_frame
from groma.scene.survey import accepted, only_rejected
from groma.solver.covariance.marginals import Covariances

#: Names of coordinates by kind of measurement; those that are angles, reported in degrees.
_COORDINATES = {
    "camera position": "xyz", "camera pose": ("x", "y", "z", "turn x", "turn y", "turn z"), "control point": "xyz",
    "mark": "uv", "distance": ("",), "known plane": ("",), "known direction": ("a", "b"),
}  # fmt: skip
_ANGLES = {"camera pose": (False,) * 3 + (True,) * 3, "known direction": (True, True)}
#: Terms that make factors of measurements.
_TERMS = (
    camera_poses.POSITIONS, camera_poses.POSES, control_points.MARKS, control_points.CONTROL, distances.TERM,
    known_geometry.PLANES, known_geometry.DIRECTIONS,
)  # fmt: skip
#: A measurement with a redundancy number below this is uncontrolled.
_UNCHECKED = 1e-6


def reliability(
    scene: Scene, problem: Problem | None = None, level: float = NORMAL.gross, power: float = GATES.power
) -> Reliability | None:
    """Compute the reliability of each external measurement: redundancy number, test and smallest detectable error.

    Parameters
    ----------
    scene : Scene
        An adjusted scene.
    problem : Problem, optional
        The problem at its solution; by default assembled with the noise stated in the scene.
    level, power : float
        Level of the test for gross errors, and the power for which the smallest detectable error is computed.

    Returns
    -------
    Reliability or None
        None if the scene holds no such measurement.

    Raises
    ------
    ProblemError
        If the poses are not determined.
    """
    check_scene_given(scene)
    if not scene.has_survey:
        return None
    near = local_frame(scene)
    scene = scene if near is None else scene.transformed(near)
    if problem is None:
        problem = assemble(scene, AssemblyOptions()).problem
    elif near is not None:
        problem = problem_at(problem, scene)
    entries = list(_entries(accepted(scene), problem.factors, problem.variables))
    frame = _frame(problem, [factor for _, _, factor in entries])
    tests = [_tested(frame, *entry) for entry in entries]
    apart = only_rejected(scene)
    rejected = _entries(apart, _factors_of(apart, problem.variables), problem.variables)
    tests += [_tested(frame, *entry, takes_part=False) for entry in rejected]
    measurements = [row for test in tests for row in _rows(scene, test, level, power)]
    wrong = gross_errors(measurements)
    components, redundancy = {}, {}
    for kind in dict.fromkeys(test.kind for test in tests):
        parts = [_squares_and_shares(scene, test, wrong) for test in tests if test.kind == kind]
        squares, redundancy[kind] = (float(sum(part)) for part in zip(*parts, strict=True))
        components[kind] = float(np.sqrt(squares / redundancy[kind])) if redundancy[kind] > _UNCHECKED else None
    return Reliability(tuple(measurements), _checked(frame, scene), components, redundancy, level, power)


@dataclass(frozen=True, eq=False)
class _Frame:
    """Covariances in the frame of the measurements: those of the scene in itself, and of its place in the world."""

    covariances: Covariances
    #: World motions (count, dof, k) by group, and their covariance (k, k); none where the first covariances have all.
    motions: dict[str, FloatArray] = field(default_factory=dict)
    place: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))


def _frame(problem: Problem, factors: list[Factor]) -> _Frame:
    """Return the covariances in the frame of the measurements.

    These may weigh so little beside the images that their part is lost in rounding; it is then added apart. They are
    then also so much less exact than the scene in itself that its part of their covariance can be taken one by one.
    """
    try:
        return _Frame(measured_covariances(problem))
    except ProblemError:
        covariances = Covariances(problem, gauge="inner")
    free = covariances.motions
    if free is None or free.count == 0:
        return _Frame(covariances)
    motions = {
        name: np.einsum("gnd,gk->ndk", part, free.combinations)
        for name, part in world_motions(problem, free.center, free.length).items()
    }
    total = np.zeros((free.count, free.count))
    alone = _Frame(covariances)
    for factor in factors:
        _, information, weight = weighted(factor, problem)
        noise = np.linalg.inv(information) / np.maximum(weight, 1e-12)[:, None, None] + _spread(alone, factor)
        J = moved(motions, factor, problem)
        total += np.einsum("nik,nij,njl->kl", J, np.linalg.inv(noise), J)
    return _Frame(covariances, motions, np.asarray(np.linalg.pinv(total, 1e-12, True), float))


@dataclass(frozen=True, eq=False)
class _Test:
    """One group of measurements: arrays by measurement and coordinate."""

    kind: str
    #: (N,) rows: of all such measurements that take part, or of all that are rejected.
    rows: IntArray
    takes_part: bool
    residual: FloatArray
    #: (N, m) residuals at full weight, (N, m, m) information and covariances of the residuals, (N, m) r_i, (N,) weights
    full: FloatArray
    information: FloatArray
    cofactor: FloatArray
    shares: FloatArray
    weight: FloatArray


def _entries(
    scene: Scene, factors: Iterable[Factor], groups: Collection[str]
) -> Iterator[tuple[str, IntArray, Factor]]:
    """Yield kind, rows in its table and factors of the measurements, as the terms made them."""
    rows = _rows_of(scene, groups)
    for factor in factors:
        groups = {ref.group for _, ref in factor.references()}
        kind = _KINDS.get(factor.type_name, "")
        if factor.type_name == "point_reprojection" and "control_points" in groups:
            kind = "mark"
        elif factor.type_name == "vector_prior" and groups == {"control_points"}:
            kind = "control point"
        elif factor.type_name == "pose_prior":  # the pose priors of the scene come first
            kind = "camera pose" if not isinstance(factor.loss, Trivial) else ""
        elif factor.type_name == "distance" and isinstance(factor.loss, Trivial):  # the held scale
            kind = ""
        if kind:
            yield kind, next(rows[kind]), factor


#: Kinds of measurements by their factors.
_KINDS = {
    "position_prior": "camera position", "distance": "distance", "on_known_plane": "known plane",
    "camera_direction": "known direction", "known_direction": "known direction",
}  # fmt: skip


def _factors_of(scene: Scene, variables: Mapping[str, Variables]) -> list[Factor]:
    """Return the factors of all measurements of a scene, as the terms make them beside those of the images."""
    draft = Draft(scene, AssemblyOptions(), dict(variables), [])
    terms = [
        term
        for term in _TERMS
        if len(getattr(scene, term.tables[0])) and all(name in variables for name in term.landmarks)
    ]
    return [group.factor for term in terms for group in term.factors(draft)]


def _rows_of(scene: Scene, groups: Collection[str]) -> dict[str, Iterator[IntArray]]:
    """Return by kind the rows of the measurements of each factor, in the order in which the terms make them."""
    apart, plane, turned, marks = scene.distances, scene.known_planes, scene.known_directions, scene.marks
    camera = scene.images.camera_idx[marks.image_idx]
    by_model = [np.flatnonzero(np.isin(camera, members)) for members in scene.cameras.by_model().values()]
    return {
        "camera position": iter([np.arange(len(scene.camera_positions))]),
        "camera pose": iter([np.arange(len(scene.camera_poses))]),
        "control point": iter([np.flatnonzero(scene.control_points.is_control)]),
        "mark": (rows for rows in by_model if len(rows)),
        "distance": (rows for _, rows in rows_by_kind(groups, apart.first_kind, apart.second_kind)),
        "known plane": (rows for _, rows in rows_by_kind(groups, plane.kind)),
        "known direction": (rows for _, rows in rows_by_kind(groups, turned.kind)),
    }


def _name(scene: Scene, kind: str, row: int) -> str:
    """Return the readable name of a measurement."""
    table = getattr(scene, TABLES[kind])
    if kind in ("camera position", "camera pose"):
        return scene.images.names[table.image_idx[row]]
    if kind == "control point":
        return table.names[row]
    if kind == "mark":
        return f"{scene.control_points.names[table.point_idx[row]]} in {scene.images.names[table.image_idx[row]]}"
    if kind == "distance":
        ends = (table.first_kind, table.first_idx), (table.second_kind, table.second_idx)
        return " to ".join(name_of(scene, int(of[row]), int(idx[row])) for of, idx in ends)
    return name_of(scene, int(table.kind[row]), int(table.idx[row]))


def _tested(frame: _Frame, kind: str, rows: IntArray, factor: Factor, takes_part: bool = True) -> _Test:
    residual, information, weight = weighted(factor, frame.covariances.problem)
    weight = weight * takes_part
    spread = _spread(frame, factor)
    eye = np.eye(residual.shape[1])
    full = np.linalg.inv(eye + (1.0 - weight)[:, None, None] * spread @ information)
    cofactor = np.linalg.inv(information) - full @ spread
    shares = np.clip(np.einsum("nij,nji->ni", cofactor, information), 0.0, 1.0)
    return _Test(
        kind, rows, takes_part, residual, np.einsum("nij,nj->ni", full, residual), information, cofactor, shares, weight
    )


def _spread(frame: _Frame, factor: Factor) -> FloatArray:
    """Return S = J Sigma J^T (N, m, m) of the free variables that factors refer to."""
    spread = _spread_inside(frame.covariances, factor)
    if frame.motions:
        J = moved(frame.motions, factor, frame.covariances.problem)
        spread = spread + J @ frame.place @ np.swapaxes(J, 1, 2)
    return spread


def _spread_inside(covariances: Covariances, factor: Factor) -> FloatArray:
    variables = covariances.problem.variables
    free = [(slot, ref) for slot, ref in factor.references() if not variables[ref.group].is_constant]
    blocks = jacobians_of(factor, variables)
    count, size = len(factor), factor.residual_size
    if not free:
        return np.zeros((count, size, size))
    if len(free) == 1:
        slot, ref = free[0]
        sigma = np.nan_to_num(covariances.of(ref.group, ref.index), nan=0.0)
        return blocks[slot.name] @ sigma @ np.swapaxes(blocks[slot.name], 1, 2)
    out = np.empty((count, size, size))
    for row in range(count):
        J = np.concatenate([blocks[slot.name][row] for slot, _ in free], axis=1)
        sigma = covariances.joint([(ref.group, int(ref.index[row])) for _, ref in free])
        out[row] = J @ np.nan_to_num(sigma, nan=0.0) @ J.T
    return out


def _rows(scene: Scene, test: _Test, level: float, power: float) -> Iterator[Measurement]:
    """Yield the measured coordinates of a group."""
    deviation = np.sqrt(np.einsum("nii->ni", np.linalg.inv(test.information)))
    scores = np.einsum("nij,nj->ni", test.information, test.full)
    of_scores = np.einsum("nij,njk,nki->ni", test.information, test.cofactor, test.information)
    limit, shift = float(-scipy.special.ndtri(level / 2.0)), noncentrality(level, power)
    angles = _ANGLES.get(test.kind, (False,) * 6)
    for row, index in enumerate(_rows_in_scene(scene, test).tolist()):
        name = _name(scene, test.kind, index)
        for k, coordinate in enumerate(_COORDINATES[test.kind]):
            share, variance = float(test.shares[row, k]), float(of_scores[row, k])
            checked = share > _UNCHECKED and variance > 0.0
            normalized = float(-scores[row, k] / np.sqrt(variance)) if checked else None
            unit = float(np.degrees(1.0)) if angles[k] else 1.0
            yield Measurement(
                kind=test.kind,
                name=name,
                coordinate=coordinate,
                sigma=unit * float(deviation[row, k]),
                residual=-unit * float(test.residual[row, k]),
                redundancy=share,
                normalized=normalized,
                detectable=unit * float(shift / np.sqrt(variance)) if checked else None,
                external=float(shift * np.sqrt((1.0 - share) / share)) if checked else None,
                is_suspect=normalized is not None and bool(abs(normalized) > limit),
                weight=float(test.weight[row]),
                row=index,
                is_rejected=not test.takes_part,
            )


def _rows_in_scene(scene: Scene, test: _Test) -> IntArray:
    """Return the rows of a test in the table of the scene, which holds what takes part and what does not."""
    rejected = getattr(getattr(scene, TABLES[test.kind]), "rejected", None)
    return test.rows if rejected is None else np.flatnonzero(rejected != test.takes_part)[test.rows]


def _squares_and_shares(scene: Scene, test: _Test, wrong: Collection[tuple[str, int]]) -> tuple[float, float]:
    """Return the weighted squares and the redundancy of the measurements of a group that are not wrong."""
    good = np.array([(TABLES[test.kind], row) not in wrong for row in _rows_in_scene(scene, test).tolist()], bool)
    good &= test.takes_part
    squares = np.einsum("ni,nij,nj->n", test.full, test.information, test.full)
    return float(squares[good].sum()), float(test.shares[good].sum())


def _checked(frame: _Frame, scene: Scene) -> tuple[CheckPoint, ...]:
    points, found = scene.control_points, []
    rows = np.flatnonzero(points.is_check)
    if len(rows) == 0 or "control_points" not in frame.covariances.problem.variables:
        return ()
    spread = frame.covariances.of("control_points", rows)
    if frame.motions:
        J = frame.motions["control_points"][rows]
        spread = spread + J @ frame.place @ np.swapaxes(J, 1, 2)
    for row, sigma in zip(rows, spread, strict=True):
        difference = points.xyz[row] - points.measured[row]
        total = points.covariance[row] + sigma
        square = float(difference @ np.linalg.solve(total, difference)) if np.isfinite(total).all() else float("nan")
        east, north, up = difference.tolist()
        x, y, z = np.sqrt(np.diag(total)).tolist()
        found.append(CheckPoint(points.names[row], (east, north, up), (x, y, z), square))
    return tuple(found)


__all__ = ["CheckPoint", "Measurement", "Reliability", "noncentrality", "reliability"]
