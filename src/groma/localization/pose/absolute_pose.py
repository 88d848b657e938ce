# SPDX-License-Identifier: BSD-3-Clause
"""The pose of a camera from matches: proposed, refined, judged.

What comes in are matches of points and segments of the image with points and lines of the world, many of them wrong,
and the noise of both. What goes out is a pose, its covariance, which matches agree, and a verdict.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from groma._typing import BoolArray, FloatArray
from groma.errors import check_kind, given_or_default
from groma.geometry import quaternion
from groma.geometry.algebra import as_rows, numbers
from groma.localization.pose.camera import CAMERA_WAY, QueryCamera
from groma.localization.pose.free_lens import FreeLens, free_lens
from groma.localization.pose.gates import VERDICT
from groma.localization.pose.hypotheses import max_errors, propose, straightened
from groma.localization.pose.lens import lens_step
from groma.localization.pose.matches import Matches
from groma.localization.pose.refinement import Refined, cells_of, fitted_at, refine
from groma.localization.pose.sites import Site, weighed
from groma.localization.pose.verdict import (
    Evidence,
    Instead,
    Shown,
    Status,
    Verdict,
    doubted_if_mirrored,
    doubted_if_missing,
    doubted_if_other_lens,
    evidence_of,
    judge,
    median_distance,
    most_votes,
    moved,
    votes_of_a_part,
    votes_of_a_rival,
)
from groma.scene.survey import check_covariance


@dataclass(frozen=True)
class PoseOptions:
    """Options of the estimation of a pose."""

    #: Seed of the random samples.
    seed: int = 0
    #: Maximum reprojection error of an inlier of a proposed pose, pixels; by default from the stated noise.
    max_error: float | None = None
    #: Estimate focal length and distortion from the matches, too.
    refine_lens: bool = False
    #: Search for a second pose that fits equally well.
    look_for_rival: bool = True
    #: Focal lengths to try, relative to that of the camera: :data:`UNKNOWN_LENS` for an unknown one.
    focal_factors: tuple[float, ...] = (1.0,)

    def lens_of(self, camera: QueryCamera) -> FreeLens | None:
        """What is estimated of the lens of a camera."""
        return free_lens(camera, "all" if self.refine_lens else "none")


#: Of so many points of a mirror image one is matched first: of the most that leave so many votes, or else of the least
#: (cost: fewer tell too little where a place repeats).
_SOME, _VOTES = (8, 4, 2), 12
#: Focal lengths of phones to telephoto lenses, over the longer side of the image, in steps of a fifth.
UNKNOWN_LENS = tuple(0.5 * 1.2**step for step in range(10))


@dataclass(frozen=True)
class MirrorQuestions:
    """What is asked of the mirror image of a photograph, to tell whether it was mirrored."""

    #: Its matches, by each so many-th point.
    matches: Callable[[int], Matches]
    #: Of the most alike matches with a pose of the photograph, and with one of its mirror image: how many are of each.
    closest: Callable[[Refined, Matches, Refined], tuple[int, int]]


@dataclass(frozen=True)
class MapQuestions:
    """What is asked of the map that matches are of; what is None is not known."""

    #: More matches once a pose is near; they refine it, and are those that the result tells of. They are no evidence
    #: that the place is right, because they were looked for where it says.
    guided: Callable[[Refined], Matches] | None = None
    #: The mirror image of the photograph.
    mirror: MirrorQuestions | None = None
    #: How much of what a pose puts into the image is there. What only one place has decides between two.
    expected: Callable[[Refined, Matches], Shown] | None = None
    #: What errors of the poses and calibrations of the map add to the joint covariance of a fit to each so many-th
    #: match.
    common: Callable[[Refined, Matches, int], FloatArray] | None = None
    #: Which matches of points show what only one place of the map has; None: all may.
    telling: Callable[[Matches], BoolArray] | None = None


@dataclass(frozen=True, eq=False)
class AbsolutePose:
    """An estimated pose, its covariance and the outcome of its tests."""

    #: ``localized``: believed; ``uncertain``: found, but chance, another place, or directions that nothing
    #: determines, are not excluded; ``failed``: none.
    status: Status
    #: Why, in words.
    sentence: str
    #: That the place is right.
    probability: float
    #: (7,) [qx qy qz qw tx ty tz]; None where none was found.
    cam_from_world: FloatArray | None
    #: (6, 6) of the left twist: shift in scene units, turn in radians, in the axes of the camera, with respect to the
    #: map. Errors of its poses and calibrations are in it (:mod:`groma.localization.errors.common_errors`).
    covariance: FloatArray | None
    #: (N,) and (M,) which matches agree.
    point_inliers: BoolArray
    line_inliers: BoolArray
    #: The camera: as given, or estimated.
    camera: QueryCamera
    #: The matches that the masks tell of.
    matches: Matches
    #: Noise of the matches that agree, in units of what was stated.
    sigma0: float = 1.0
    #: Another pose that fits about as well, where there is one.
    rival: FloatArray | None = None
    #: Whether what agrees would do, but what else the photograph shows, or does not, speaks against the pose.
    contradicted: bool = False
    #: Whether all features near the pose say so, however it was found: more matches to find one by change nothing.
    settled: bool = False
    other_focal: bool = False  #: Whether that is another focal length than was given.

    @property
    def center(self) -> FloatArray | None:
        """(3,) camera centre in the world."""
        pose = self.cam_from_world
        return None if pose is None else -quaternion.rotate(quaternion.conjugate(pose[None, :4]), pose[None, 4:])[0]

    @property
    def center_covariance(self) -> FloatArray | None:
        """(3, 3) of the camera centre in the world."""
        if self.cam_from_world is None or self.covariance is None:
            return None
        R = quaternion.to_matrix(self.cam_from_world[None, :4])[0]
        if not np.isfinite(self.covariance).all():
            return np.full((3, 3), np.inf)
        return R.T @ self.covariance[:3, :3] @ R

    @property
    def center_sigma(self) -> FloatArray | None:
        """(3,) standard deviations of the camera centre along the axes of the world."""
        covariance = self.center_covariance
        return None if covariance is None else np.sqrt(np.diag(covariance))

    @property
    def rotation_sigma_deg(self) -> float | None:
        """Standard deviation of the rotation, all axes together, degrees."""
        if self.covariance is None:
            return None
        return float(np.rad2deg(np.sqrt(np.trace(self.covariance[3:, 3:]))))


def estimate_absolute_pose(
    camera: QueryCamera,
    points2d: npt.ArrayLike | None = None,
    points3d: npt.ArrayLike | None = None,
    segments2d: npt.ArrayLike | None = None,
    segments3d: npt.ArrayLike | None = None,
    *,
    sigma: tuple[float, float] = (1.0, 1.0),
    covariances: tuple[npt.ArrayLike | None, npt.ArrayLike | None] = (None, None),
    options: PoseOptions | None = None,
) -> AbsolutePose:
    """Estimate the pose of a camera robustly from matches of points, lines or both.

    Parameters
    ----------
    camera : QueryCamera
        Calibration of the image.
    points2d, points3d : (N, 2), (N, 3)
        Points in the image (the first pixel's centre is 0.5, 0.5) and in the world.
    segments2d, segments3d : (M, 2, 2), (M, 2, 3)
        Ends of segments in the image, and two places on each line in the world; the ends need not correspond. Several
        lines may claim one segment, and several points one pixel.
    sigma : (float, float)
        Standard deviations in the image, pixels: of a coordinate of a point, and of the end of a segment across it.
    covariances : ((N, 3, 3), (M, 6, 6))
        Of the points, and of (moment, direction) of the lines with a unit direction; None: they are exact.
    options : PoseOptions, optional
        How it is looked for.

    Returns
    -------
    AbsolutePose
        If no pose is found, its status is ``failed`` and its sentence says why.

    Raises
    ------
    InputError
        If an argument is no numbers, or of another shape; a number is not finite, or no covariance.
    """
    check_kind(camera, QueryCamera, "camera", CAMERA_WAY)
    check_kind(covariances, (tuple, list), "covariances", "Pass (of points, of lines), None where they are exact.")
    of_points, of_segments = as_rows([sigma], (2,), "[sigma]")[0]
    points, segments = _rows("points2d", points2d, 2), _rows("segments2d", segments2d, 2, 2)
    of = ((points, 3, covariances[0]), (segments, 6, covariances[1]))
    known = [np.zeros((len(rows), n, n)) if one is None else numbers(one, "covariances") for rows, n, one in of]
    rows = points, _rows("points3d", points3d, 3), segments, _rows("segments3d", segments3d, 2, 3)
    matches = Matches(*rows, np.full(len(points), of_points), np.full(len(segments), of_segments), *known)
    check_covariance("covariances of points", matches.point_covariance, exact=True)
    check_covariance("covariances of lines", matches.line_covariance, exact=True)
    return pose_from_matches(camera, matches, options)


def pose_from_matches(
    camera: QueryCamera,
    matches: Matches,
    options: PoseOptions | None = None,
    places: int = 1,
    enough: int = 0,
    of_map: MapQuestions = MapQuestions(),
) -> AbsolutePose:
    """Estimate a pose as :func:`estimate_absolute_pose` does.

    Parameters
    ----------
    camera, matches, options
        See there.
    places
        Parts of a map that the matches were looked for in; chance has so many opportunities.
    enough
        A pose with fewer votes is of no interest: it is ``failed``, without asking what else speaks against it.
    of_map : MapQuestions
        What is asked of the map.
    """
    options, guided, expected = given_or_default(options, PoseOptions), of_map.guided, of_map.expected
    if most_votes(matches, camera) < enough:
        return _failed(camera, matches)
    best = _best(camera, matches, options)
    if best is None:
        return _failed(camera, matches)
    first = evidence_of(best, matches, places)

    def near(start: Refined) -> Site:
        assert guided is not None
        used, lens = guided(start), options.lens_of(camera)
        errors = _errors(used, options)
        whole = refine(start.camera, used, start.pose, errors, lens, gathered=True)
        own = fitted_at(best.one.at(whole.pose, whole.camera.params), whole.camera, matches, errors, lens)
        return seen(whole, used, own, evidence_of(own, matches, places))

    def seen(whole: Refined, used: Matches, own: Refined, evidence: Evidence) -> Site:
        if expected is None or not evidence.significant or evidence.agree < enough:
            return Site(whole, used, own, evidence)
        return Site(whole, used, own, evidence, expected(whole, used))

    here = near(best) if guided is not None and first.significant else seen(best, matches, best, first)
    if here.evidence.agree < enough:
        return _failed(camera, matches)
    other = _rival(matches, best, options, places, first) if options.look_for_rival and first.significant else None
    here, there, others = weighed(here, other, near if guided else None, matches, expected is not None, of_map.telling)
    return _judged(here, others, None if there is None else there.best.pose, matches, options, of_map)


def _judged(
    here: Site,
    others: list[Instead],
    rival: FloatArray | None,
    matches: Matches,
    options: PoseOptions,
    of_map: MapQuestions,
) -> AbsolutePose:
    """A pose and what is said of it."""
    best, used = here.best, here.used
    covariance = best.covariance(used)
    if of_map.common is not None and np.isfinite(covariance).all():
        covariance = covariance + of_map.common(best, used, 1)[:6, :6]
    verdict = judge(best, covariance, median_distance(best.pose, _seen(used, best)), here.evidence, others)
    if verdict.status == "localized":
        verdict = doubted_if_missing(verdict, here.shown.parts, here.shown.missing)
    if of_map.mirror is not None and verdict.status == "localized":
        verdict = _unless_mirrored(verdict, here, of_map.mirror, matches, options)
    # What was looked for near a wrong pose may be what agrees with its lens; what was matched without it is asked, too.
    for fit, of in ((best, used), (here.own, matches))[: 0 if options.refine_lens else 1 + (used is not matches)]:
        if verdict.status == "localized":
            step = lens_step(fit, of, _errors(of, options), of_map.common, gathered=of is used)
            verdict = doubted_if_other_lens(verdict, step, of is used)
    failed = verdict.status == "failed"
    return AbsolutePose(
        verdict.status,
        verdict.sentence,
        verdict.probability,
        None if failed else best.pose,
        None if failed else covariance,
        best.point_inliers,
        best.line_inliers,
        best.camera,
        used,
        best.sigma0,
        rival if verdict.status == "uncertain" else None,
        verdict.contradicted,
        verdict.settled,
        verdict.other_focal,
    )


def _unless_mirrored(
    verdict: Verdict, here: Site, mirror: MirrorQuestions, matches: Matches, options: PoseOptions
) -> Verdict:
    """Return a verdict, or another one where the mirror image of a photograph fits about as well, and by matches that
    are more alike.

    Some of its points are matched first: mostly far too few of them agree with any pose. Chance may explain its
    pose: it has no lines, which may be what places the photograph, and matches by chance are not the most alike.
    """
    agree = len(np.unique(cells_of(matches.points2d, here.own.camera, VERDICT.cells)[here.own.point_inliers]))
    wanted = votes_of_a_rival(agree)
    parts = [(step, votes_of_a_part(wanted, 1.0 / step)) for step in _SOME]
    step, votes = next((one for one in parts if one[1] >= _VOTES), parts[-1])
    if votes:
        some = mirror.matches(step)
        other = _best_of_others(here.own.camera, some, options, votes)
        if other is None or evidence_of(other, some).agree < votes:
            return verdict
    every = mirror.matches(1)
    other = _best_of_others(here.own.camera, every, options, wanted)
    if other is None or evidence_of(other, every).agree < wanted:
        return verdict
    return doubted_if_mirrored(verdict, *mirror.closest(here.best, here.used, other))


def _errors(matches: Matches, options: PoseOptions) -> tuple[float, float]:
    return max_errors(matches) if options.max_error is None else (options.max_error, options.max_error)


def _best_of_others(camera: QueryCamera, matches: Matches, options: PoseOptions, votes: int) -> Refined | None:
    """The best pose of matches, if it may get so many votes; it is not looked for longer than those would take."""
    possible = most_votes(matches, camera)
    if possible < max(votes, 1):
        return None
    return _best(camera, matches, replace(options, refine_lens=False, focal_factors=(1.0,)), votes / possible, votes)


def _best(
    camera: QueryCamera, matches: Matches, options: PoseOptions, share: float = 0.0, least: int = 0
) -> Refined | None:
    """The pose that most agrees with, refined; None where there is none. Of several focal lengths the best.

    ``share`` is the least share of the matches that such a pose is of interest with, ``least`` their number before it
    is refined.
    """
    errors = _errors(matches, options)
    starts = [_with_focal_length(camera, factor) for factor in options.focal_factors]
    found = [(propose(straightened(one, matches), errors, options.seed, share, least), one) for one in starts]
    refined = [refine(one, matches, pose, errors, options.lens_of(camera)) for pose, one in found if pose is not None]
    return max(refined, key=lambda one: int(one.point_inliers.sum() + one.line_inliers.sum()), default=None)


def _with_focal_length(camera: QueryCamera, factor: float) -> QueryCamera:
    if factor == 1.0:
        return camera
    params = camera.params.copy()
    params[list(camera.kind.focal_indices)] *= factor
    return QueryCamera(camera.model, params, camera.width, camera.height)


def _rival(
    matches: Matches, best: Refined, options: PoseOptions, places: int, first: Evidence
) -> tuple[Refined, Evidence] | None:
    """The best pose of what disagrees with the first, if it is another one."""
    squares = [np.where(np.isfinite(one.square), one.square, np.inf) for one in (best.points, best.lines)]
    left = [square > 4.0 * best.limit for square in squares]
    rest = matches.take(left[0], left[1])
    other = _best_of_others(best.camera, rest, options, votes_of_a_rival(first.agree))
    if other is None:
        return None
    found = evidence_of(other, rest, places)
    way = moved(best.camera, best.pose, other.pose, _seen(rest, other))
    is_other = way > VERDICT.distinct * max_errors(matches)[0]
    return (other, found) if is_other and found.significant else None


def _seen(matches: Matches, refined: Refined) -> FloatArray:
    """Places (n, 3) in the world that agree with a pose."""
    lines = matches.segments3d[refined.line_inliers].mean(axis=1)
    return np.concatenate([matches.points3d[refined.point_inliers], lines])


def _failed(camera: QueryCamera, matches: Matches) -> AbsolutePose:
    number = matches.num_points + matches.num_lines
    why = f"No pose agrees with enough of the {number} matches." if number else "Nothing of the map was found in it."
    none = np.zeros(matches.num_points, bool), np.zeros(matches.num_lines, bool)
    return AbsolutePose("failed", why, 0.0, None, None, *none, camera, matches)


def _rows(name: str, value: npt.ArrayLike | None, *shape: int) -> FloatArray:
    return np.zeros((0, *shape)) if value is None else np.atleast_1d(numbers(value, name))
