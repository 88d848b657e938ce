# SPDX-License-Identifier: BSD-3-Clause
r"""How a camera may have moved between two frames, and what later frames say of it.

In come pixels of the same points. Two views of a plane allow two motions that explain them equally well, and an
essential matrix of such points is either of them by chance. So all that the essential matrix and the homography allow
are kept as candidates; each is adjusted with the points in all views so far, under a loss, and judged by its cost

.. math:: c = \tfrac12 \sum \min(\|r\|^2 / \sigma^2,\, g^2),

where a pixel that disagrees, and a point behind a camera, counts as an outlier at the gate g. The true noise of points
that were followed is not known, and what one point errs in several views is much the same; so n points tell about two
candidates

.. math:: \tfrac{n}{2} \ln \frac{c_1}{c_2}

nats, the ratio of their likelihoods at the noise that suits each best. A candidate is ruled out when that is odds of
1 in 100. But calibration, rolling shutter and the motion itself err alike for neighbours: points of one cell of the
image are not as many witnesses. Sums of residuals over cells tell, in every frame anew, how many they are: with
independent errors the square of a sum is the sum of the squares, on average, and n is the number of points over the
ratio of the two.

Reference: O. Faugeras, F. Lustman, *Motion and structure from motion in a piecewise planar environment*, 1988.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.adjustment.assemble import assemble
from groma.factors.losses import Cauchy
from groma.gates import NORMAL
from groma.geometry import quaternion, se3
from groma.localization.pose.absolute_pose import PoseOptions, estimate_absolute_pose
from groma.scene import Cameras, PointObservations, Points, Scene
from groma.solver.options import SolverOptions
from groma.solver.solve import solve
from groma.tracking.frame.camera import PINHOLE, TrackCamera, into
from groma.tracking.frame.rectification import cells_of
from groma.tracking.gates import StartGates
from groma.tracking.map.map_scene import TRACKING

LOSS = Cauchy(1.5)
_ASSEMBLY = replace(TRACKING, gauge="first_camera", loss=LOSS)
_SOLVER = SolverOptions(max_iterations=50, function_tolerance=1e-5, threads=1)
IDENTITY = np.array([0, 0, 0, 1, 0, 0, 0.0])


@dataclass(frozen=True, eq=False)
class Candidate:
    """A motion, and the points it gives."""

    #: (V, 7) cam_from_world of the views; the first is at the origin.
    poses: FloatArray
    #: (N, 3) points.
    places: FloatArray
    #: Negative log-likelihood of the pixels.
    cost: float = np.inf
    #: (N,) which points agree with all views.
    agrees: BoolArray = field(default_factory=lambda: np.zeros(0, bool))
    #: How many points with independent errors would tell as much.
    witnesses: float = 0.0


def motions(camera: TrackCamera, one: FloatArray, two: FloatArray, gates: StartGates) -> list[FloatArray]:
    """Return the motions, cam_from_world (7,) with a translation of length one, that two views may show.

    With little parallax it is left open whether points are in front of the camera or, for a motion the other way,
    beyond infinity; so both ways are returned.

    Parameters
    ----------
    camera
        Of both views.
    one, two : (N, 2) float64
        Pixels of the same points, with outliers.
    gates
        How near points are to epipolar lines, and to where a homography takes them.
    """
    K, found = camera.matrix_opencv, []
    first, second = one - 0.5, two - 0.5
    E, mask = cv2.findEssentialMat(first, second, K, method=cv2.USAC_MAGSAC, threshold=gates.max_error)
    if E is not None and E.shape == (3, 3):
        _, R, t, _ = cv2.recoverPose(E, first, second, K, mask=mask)
        found.append((np.asarray(R), np.asarray(t)))
    H, mask = cv2.findHomography(first, second, cv2.USAC_MAGSAC, gates.max_error)
    if H is not None:
        on_plane = camera.bearings(one[mask.ravel() > 0])
        for R, t, normal in zip(*cv2.decomposeHomographyMat(H, K)[1:], strict=True):
            if np.mean(on_plane @ np.asarray(normal).ravel() > 0.0) > 0.5 and np.linalg.norm(t) > 0.0:
                found.append((np.asarray(R), np.asarray(t)))
    return [
        np.concatenate([quaternion.from_matrix(R.astype(np.float64)), sign * t.ravel() / np.linalg.norm(t)])
        for R, t in found
        for sign in (1.0, -1.0)
    ]


def intersected(camera: TrackCamera, one: FloatArray, two: FloatArray, pose: FloatArray) -> FloatArray:
    """Points (N, 3) in front of the first camera, nearest to the rays of two views, at most far away."""
    ray1, rotation = camera.bearings(one), quaternion.to_matrix(pose[:4])
    ray2, center = camera.bearings(two) @ rotation, -rotation.T @ pose[4:]
    a, b, c = (ray1 * ray1).sum(1), (ray1 * ray2).sum(1), (ray2 * ray2).sum(1)
    inverse = (a * c - b * b) / np.where((d := c * (ray1 @ center) - b * (ray2 @ center)) != 0.0, d, 1e-300)
    return ray1 / np.clip(inverse, 1e-3 / np.linalg.norm(center), None)[:, None]


def adjusted(camera: TrackCamera, candidate: Candidate, pixels: FloatArray, sigma: float, gate: float) -> Candidate:
    """Adjust a candidate to its views; its points begin, and are judged, where they agree best with its motion.

    Where the parallax is below the noise, points end behind a camera or far from where they agree, and a point there
    counts as an outlier in every view: a few of them would tell more than all others.

    Parameters
    ----------
    camera, candidate
        The camera, and where to begin.
    pixels : (V, N, 2) float64
        Pixels of the points in every view.
    sigma : float
        Their standard deviation, pixels.
    gate : float
        A pixel beyond so many standard deviations disagrees.
    """
    views, count = len(pixels), len(candidate.places)
    places, _ = _placed(camera, candidate.poses, candidate.places, pixels, gate * sigma)
    image, point = np.repeat(np.arange(views), count), np.tile(np.arange(count), views)
    cameras = Cameras.of([1], [PINHOLE], [camera.params], [camera.width, camera.height])
    scene = Scene.from_images(
        cameras,
        [str(view) for view in range(views)],
        np.zeros(views, int),
        candidate.poses,
        points=Points(np.arange(count) + 1, places, np.full((count, 3), 128, np.uint8), np.zeros(count)),
        point_observations=PointObservations.numbered(image, point, pixels.reshape(-1, 2), np.full(len(image), sigma)),
    )
    solution = solve(assemble(scene, _ASSEMBLY).problem, _SOLVER)
    poses, places = solution["frames"], solution["points"]
    # The first camera is the world, and the usual depth the unit.
    places = into(poses[0], places)
    poses = se3.compose(poses, np.tile(se3.inverse(poses[:1]), (views, 1)))
    scale = float(np.median(np.abs(places[:, 2])))
    poses[:, 4:] /= scale
    places, squared = _placed(camera, poses, places / scale, pixels, gate * sigma)
    cost = 0.5 * float(np.minimum(squared / sigma**2, gate**2).sum())
    agrees = np.asarray((squared < (gate * sigma) ** 2).all(axis=0))
    return Candidate(poses, places, cost, agrees, _witnesses(camera, poses, places[agrees], pixels[:, agrees]))


def _witnesses(camera: TrackCamera, poses: FloatArray, places: FloatArray, pixels: FloatArray) -> float:
    """Return how many points with independent errors would tell as much as these; see the formula above."""
    away = np.array([camera.project(into(p, places)) - seen for p, seen in zip(poses, pixels, strict=True)])
    cell = np.unique(cells_of(camera, pixels[0]), return_inverse=True)[1].ravel()
    sums = np.zeros((cell.max(initial=-1) + 1, away.shape[0], 2))
    np.add.at(sums, cell, away.transpose(1, 0, 2))
    return len(places) / max(1.0, float((sums**2).sum() / max((away**2).sum(), 1e-300)))


def _placed(
    camera: TrackCamera, poses: FloatArray, places: FloatArray, pixels: FloatArray, max_error: float
) -> tuple[FloatArray, FloatArray]:
    """Return points (N, 3) where they were or where two rays meet, whichever agrees best, and squared errors (V, N).

    Errors are in pixels, counted up to the largest that agrees.
    """
    others = [
        intersected(camera, pixels[0], seen, pose)
        for pose, seen in zip(poses[1:], pixels[1:], strict=True)
        if pose[4:].any()
    ]
    proposed = np.array([places, *others])
    squared = np.array(
        [[_squared(camera, pose, at, seen) for pose, seen in zip(poses, pixels, strict=True)] for at in proposed]
    )
    best = np.minimum(squared, max_error**2).sum(axis=1).argmin(axis=0)
    points = np.arange(len(places))
    return proposed[best, points], squared[best, :, points].T


def continued(
    camera: TrackCamera, candidate: Candidate, pixels: FloatArray, sigma: float, gates: StartGates
) -> Candidate:
    """Return a candidate with the pose of a third view: from where it shows the candidate's points, or the last one.

    Points too far away to tell a position are left out; their numbers would spoil a closed form.
    """
    max_error = NORMAL.coordinate * sigma
    near = candidate.agrees & (candidate.places[:, 2] < gates.max_depth)
    poses = [candidate.poses[-1]]
    if near.sum() >= 4:
        options = PoseOptions(max_error=max_error, look_for_rival=False)
        found = estimate_absolute_pose(
            camera.query, pixels[near], candidate.places[near], sigma=(sigma, sigma), options=options
        ).cam_from_world
        poses += [] if found is None else [found]
    costs = [np.minimum(_squared(camera, pose, candidate.places, pixels), max_error**2).sum() for pose in poses]
    return replace(candidate, poses=np.concatenate([candidate.poses[:2], poses[int(np.argmin(costs))][None]]))


def proposed(camera: TrackCamera, pixels: FloatArray, sigma: float, gates: StartGates) -> list[Candidate]:
    """Return the motions that two views (2, N, 2) allow, adjusted to them."""
    one, two = pixels
    begun = [
        Candidate(np.stack([IDENTITY, pose]), intersected(camera, one, two, pose))
        for pose in motions(camera, one, two, gates)
    ]
    return [adjusted(camera, candidate, pixels, sigma, NORMAL.coordinate) for candidate in begun]


def with_third(
    camera: TrackCamera, candidate: Candidate, pixels: FloatArray, sigma: float, gates: StartGates
) -> Candidate:
    """Return a candidate of the first two of three views (3, N, 2), or of all, adjusted to all."""
    third = continued(camera, candidate, pixels[2], sigma, gates)
    return adjusted(camera, third, pixels, sigma, NORMAL.coordinate)


def proposed_by_ends(camera: TrackCamera, pixels: FloatArray, sigma: float, gates: StartGates) -> list[Candidate]:
    """Return the motions that the first and the last of three views (3, N, 2) allow, adjusted to all."""
    order = [0, 2, 1]
    found = proposed(camera, pixels[order[:2]], sigma, gates)
    found = [with_third(camera, candidate, pixels[order], sigma, gates) for candidate in found]
    return [replace(candidate, poses=candidate.poses[order]) for candidate in found]


def _squared(camera: TrackCamera, pose: FloatArray, places: FloatArray, pixels: FloatArray) -> FloatArray:
    """(N,) squared distances of points from their pixels; infinite behind the camera."""
    away = camera.project(into(pose, places)) - pixels
    return np.nan_to_num((away**2).sum(axis=-1), nan=np.inf)


def likely(candidates: list[Candidate], gates: StartGates) -> list[Candidate]:
    """Return the candidates that are not ruled out, the best first, each motion once."""
    kept: list[Candidate] = []
    for candidate in sorted(candidates, key=lambda one: one.cost):
        if kept and behind(candidate, kept[0], gates):
            break
        if not any(_same(candidate.poses[-1], other.poses[-1], gates) for other in kept):
            kept.append(candidate)
    return kept


def behind(candidate: Candidate, best: Candidate, gates: StartGates) -> bool:
    """Whether a candidate is ruled out by another one; see the formula above."""
    least = gates.least_cost * len(candidate.places)
    nats = 0.5 * best.witnesses * math.log((candidate.cost + least) / (best.cost + least))
    return nats > -math.log(NORMAL.false_alarm)


def _same(one: FloatArray, two: FloatArray, gates: StartGates) -> bool:
    """Whether two poses are one but for what an adjustment leaves."""
    turn = 2.0 * np.arccos(min(1.0, abs(float(one[:4] @ two[:4]))))
    shift, length = np.linalg.norm(one[4:] - two[4:]), np.linalg.norm(one[4:])
    return bool(turn < gates.same_turn and shift < gates.same_shift * length)
