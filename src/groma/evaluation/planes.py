# SPDX-License-Identifier: BSD-3-Clause
r"""How well planes agree with reference planes or with points.

An infinite plane is compared with a reference plane at the *place* where the reference was seen: the centroid of what
lies on it, where that is known, else the point of it closest to the middle of the scene.

.. math:: \alpha = \angle(\pm n, n_r), \qquad o = | n \cdot x_r + w |

A pair may match when angle and offset are within their limits. Every plane is in one pair at most; the pairs are
those with the smallest sum of :math:`\alpha / \alpha_{max} + o / o_{max}` among those with the most matches. A
surface that is found twice therefore counts once for the recall and against the precision; where in the plane the
estimate was seen plays no part, so pieces of one wall in one plane should be one reference plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.errors import InputError, ShapeError
from groma.evaluation.gates import SCORES
from groma.evaluation.lines import threshold_list
from groma.evaluation.poses import as_numbers
from groma.geometry.algebra import finite_rows
from groma.scene import Scene
from groma.scene.checks import check_scene_given

#: Numbers held at once while points are compared with planes.
_CHUNK = 2_000_000


@dataclass(frozen=True)
class PlaneScores:
    """Agreement of planes with reference planes."""

    #: Share of estimated planes that match a reference plane.
    precision: float
    #: Share of reference planes that are matched.
    recall: float
    #: Mean, median and largest angle between the normals of matched planes, degrees.
    normal_deg_mean: float
    normal_deg_median: float
    normal_deg_max: float
    #: Mean, median and largest offset of matched planes at the reference's place, scene units.
    offset_mean: float
    offset_median: float
    offset_max: float
    #: Number of estimated and of reference planes.
    num_planes: int
    num_reference: int
    #: (m, 2) matched pairs: estimated plane, reference plane.
    matches: IntArray

    def to_dict(self) -> dict[str, object]:
        """Return the scores for a machine-readable report."""
        return as_numbers(self, "matches") | {"num_matches": len(self.matches)}


@dataclass(frozen=True)
class PointPlaneScores:
    """Agreement of planes with points of surfaces, by threshold (scene units)."""

    #: Share of the points that lie within the threshold of any plane.
    inlier_share: dict[float, float]
    #: Root mean square distance of the points that do.
    inlier_rmse: dict[float, float]
    #: Number of points and of planes.
    num_points: int
    num_planes: int

    def to_dict(self) -> dict[str, object]:
        """Return the scores for a machine-readable report."""
        return as_numbers(self)


def match_planes(
    estimate: npt.ArrayLike,
    reference: npt.ArrayLike,
    places: npt.ArrayLike,
    max_angle_deg: float = SCORES.plane_angle_deg,
    max_offset: float = np.inf,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return matched pairs (m, 2), the angle (degrees) and the offset (scene units) of each; see the module.

    Parameters
    ----------
    estimate, reference : (K, 4), (R, 4) float
        Planes n.X + w = 0 of any scale.
    places : (R, 3) float
        Where each reference plane was seen.
    max_angle_deg, max_offset : float
        Limits of a match.
    """
    planes, truth = _unit_planes("estimate", estimate), _unit_planes("reference", reference)
    where = finite_rows("places", places, (3,))
    if len(where) != len(truth):
        raise ShapeError(f"places must have one row per reference plane ({len(truth)}); got {len(where)}.")
    if not (max_angle_deg > 0 and max_offset > 0):
        raise InputError(f"Limits must be positive; got {max_angle_deg} degrees and {max_offset}.")
    # arccos of the product is blind below 1e-8; half the chord is not.
    product = planes[:, :3] @ truth[:, :3].T
    chord = planes[:, None, :3] - np.where(product < 0, -1, 1)[..., None] * truth[None, :, :3]
    angle = np.rad2deg(2 * np.arcsin(np.minimum(np.linalg.norm(chord, axis=2) / 2, 1)))
    offset = np.abs(planes[:, :3] @ where.T + planes[:, 3:])
    allowed = (angle <= max_angle_deg) & (offset <= max_offset)
    scale = max_offset if np.isfinite(max_offset) else max(float(offset.max(initial=0)), 1e-300)
    # A forbidden pair costs more than all allowed ones together.
    forbidden = 2.0 * (min(allowed.shape) + 1)
    from scipy.optimize import linear_sum_assignment  # takes a third of a second to import

    rows, columns = linear_sum_assignment(np.where(allowed, angle / max_angle_deg + offset / scale, forbidden))
    kept = allowed[rows, columns]
    pairs = np.column_stack([rows[kept], columns[kept]])
    return pairs, angle[pairs[:, 0], pairs[:, 1]], offset[pairs[:, 0], pairs[:, 1]]


def score_planes(
    estimate: npt.ArrayLike,
    reference: npt.ArrayLike,
    places: npt.ArrayLike,
    max_angle_deg: float = SCORES.plane_angle_deg,
    max_offset: float = np.inf,
) -> PlaneScores:
    """Compare planes with reference planes in the same frame; see :func:`match_planes` for the parameters.

    Scores without any plane or match are NaN.
    """
    pairs, angle, offset = match_planes(estimate, reference, places, max_angle_deg, max_offset)
    num_planes, num_reference = len(np.asarray(estimate)), len(np.asarray(reference))
    statistics = [
        float(how(values)) if len(values) else float("nan")
        for values in (angle, offset)
        for how in (np.mean, np.median, np.max)
    ]
    return PlaneScores(
        len(pairs) / num_planes if num_planes else float("nan"),
        len(pairs) / num_reference if num_reference else float("nan"),
        *statistics,
        num_planes=num_planes,
        num_reference=num_reference,
        matches=pairs,
    )


def evaluate_planes(
    estimate: Scene, reference: Scene, max_angle_deg: float = SCORES.plane_angle_deg, max_offset: float | None = None
) -> PlaneScores:
    """Compare the planes of two scenes in the same frame.

    Parameters
    ----------
    estimate, reference : Scene
        The scene to judge, and the one taken for true.
    max_angle_deg : float
        Largest angle of a match.
    max_offset : float, optional
        Largest offset of a match, scene units; by default a hundredth of the reference's extent, the diagonal of the
        box that holds its points and lines except, on every side, the outermost two in a hundred: single points far
        away, as reconstructions have them, would make every offset a match.

    Raises
    ------
    InputError
        If the reference has no planes, or no extent and no offset is given.
    """
    check_scene_given(estimate, "estimate")
    check_scene_given(reference, "reference")
    if reference.num_planes == 0:
        raise InputError("The reference has no planes. Pass a scene with planes, or points to compare with.")
    if max_offset is None:
        every = np.concatenate([reference.points.xyz, reference.lines.segments.reshape(-1, 3)])
        sides = np.diff(np.percentile(every, (2, 98), axis=0), axis=0) if len(every) else np.zeros(3)
        max_offset = SCORES.line_shares[-1] * float(np.linalg.norm(sides))
        if not max_offset > 0:
            raise InputError("The reference has no extent; pass max_offset in scene units.")
    return score_planes(
        estimate.planes.hesse, reference.planes.hesse, plane_places(reference), max_angle_deg, max_offset
    )


def plane_places(scene: Scene) -> FloatArray:
    """Return where each plane of a scene was seen, (K, 3): the foot of the centroid of its points and lines.

    Planes with nothing on them get the foot of the centroid of all points and lines.
    """
    places = np.concatenate([scene.points.xyz, scene.lines.segments.mean(1)])
    on_plane = scene.relations.line_on_plane + np.array([scene.num_points, 0])
    member, plane = np.concatenate([scene.relations.point_on_plane, on_plane]).T
    total = np.zeros((scene.num_planes, 3))
    np.add.at(total, plane, places[member])
    count = np.bincount(plane, minlength=scene.num_planes)[:, None]
    middle = places.mean(0) if len(places) else np.zeros(3)
    centre = np.where(count > 0, total / np.maximum(count, 1), middle)
    hesse = scene.planes.hesse
    return centre - (np.einsum("ij,ij->i", hesse[:, :3], centre) + hesse[:, 3])[:, None] * hesse[:, :3]


def score_planes_by_points(
    planes: npt.ArrayLike, points: npt.ArrayLike, thresholds: Sequence[float] | None = None
) -> PointPlaneScores:
    """Compare planes with points of surfaces in the same frame: which share of them do the planes explain?

    Parameters
    ----------
    planes : (K, 4) float
        Planes n.X + w = 0 of any scale.
    points : (P, 3) float
        Points, for example of a scan.
    thresholds : sequence of float, optional
        Distances in scene units; by default 1, 5 and 10 thousandths of the points' extent.
    """
    hesse, places = _unit_planes("planes", planes), finite_rows("points", points, (3,))
    if len(places) == 0:
        raise InputError("There are no points to compare with.")
    taus = threshold_list(thresholds, float(np.linalg.norm(np.ptp(places, axis=0))))
    distance = np.full(len(places), np.inf)
    step = max(1, _CHUNK // max(len(hesse), 1))
    for start in range(0, len(places) if len(hesse) else 0, step):
        part = places[start : start + step]
        distance[start : start + step] = np.abs(part @ hesse[:, :3].T + hesse[:, 3]).min(1)
    near = {tau: distance[distance <= tau] for tau in taus}
    return PointPlaneScores(
        {tau: len(found) / len(places) for tau, found in near.items()},
        {tau: float(np.sqrt(np.mean(found**2))) if len(found) else float("nan") for tau, found in near.items()},
        len(places),
        len(hesse),
    )


def _unit_planes(name: str, planes: npt.ArrayLike) -> FloatArray:
    hesse = finite_rows(name, planes, (4,))
    length = np.linalg.norm(hesse[:, :3], axis=1, keepdims=True)
    if not (length > 0).all():
        raise InputError(f"{name} holds a plane without a normal, row {int(length.argmin())}. Remove it.")
    return hesse / length
