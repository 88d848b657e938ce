# SPDX-License-Identifier: BSD-3-Clause
"""Does the lens that was given agree with what is seen? An estimate of focal length and principal point tells.

With a wrong focal length a pose nearer or farther fits about as well, by the distances of its landmarks; its stated
deviation then is that of another camera. Where a piece of a photograph is moved in the image, as if it were cropped or
put together of pieces, a pose turned by as much fits about as well, and its principal point is where the piece came
from. What agrees with that pose was chosen by it, so that one step from there says little: the lens is fitted to all
that is near, as a pose is, until that stays the same. Where one step of all that is near is far too small for any
doubt, it is the answer. Where things repeat, all that is near a pose with a wrong lens may agree with both; so what was
matched without the pose is asked, too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray
from groma.factors.losses import Cauchy
from groma.gates import gate
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.free_lens import FreeLens, free_lens
from groma.localization.pose.gates import REFINEMENT, VERDICT, VerdictGates
from groma.localization.pose.matches import Matches
from groma.localization.pose.one_pose import OnePose
from groma.localization.pose.pose_fit import full_step
from groma.localization.pose.pose_problem import problem_of
from groma.localization.pose.refinement import Refined, fit_to_near, fitted_at, weighed


@dataclass(frozen=True)
class LensGates:
    """What a lens is estimated from."""

    matches: int = gate(400, "matches", "at most, every so many-th", "cost: of a fit")
    small: float = gate(
        0.05, "share", "of a step that tells another lens, that one step from the pose may have without a fit",
        "derived from wrong focal lengths on cabinet, kitchen, castle: one step is 0.07 to 0.6 of the estimate",
    )  # fmt: skip
    small_of_others: float = gate(
        0.2, "share", "the same, by what was matched without the pose",
        "derived from wrong focal lengths on kitchen and castle: one step is 0.4 to 1 of the estimate",
    )  # fmt: skip


GATES = LensGates()


@dataclass(frozen=True)
class LensStep:
    """How far an estimate of a lens is from the one that was given."""

    #: The share by which the focal length should grow, and its standard deviation; the latter is infinite where that is
    #: not determined, and where the share is too small to tell another lens.
    focal: float
    focal_sigma: float
    #: How far the principal point moves if it is estimated, too, focal lengths; and the squared step of both in units
    #: of their covariance. Zero where it is near, or nothing determines it.
    shift: float = 0.0
    square: float = 0.0


def lens_step(
    refined: Refined,
    matches: Matches,
    max_error: tuple[float, float],
    common: Callable[[Refined, Matches, int], FloatArray] | None = None,
    gates: VerdictGates = VERDICT,
    gathered: bool = True,
) -> LensStep:
    """Estimate the focal length near a pose, and the principal point if it may be far.

    Parameters
    ----------
    refined, matches
        A pose with the lens that was given, and matches.
    max_error
        Of :func:`groma.localization.pose.refinement.refine`.
    common
        What errors of the map add to the joint covariance of a fit to each so many-th match; None: nothing.
    gates
        What far means.
    gathered
        The matches were looked for near the pose. Else they were found without it, mostly few and some of them wrong:
        they are not asked for the principal point.
    """
    focal, shift = _one_step(refined, matches)
    small = GATES.small if gathered else GATES.small_of_others
    if abs(focal) <= small * gates.focal and (shift <= small * gates.shift or not gathered):
        return LensStep(focal, np.inf)
    each = -(-(matches.num_points + matches.num_lines) // GATES.matches)
    some = matches.take(np.arange(0, matches.num_points, each), np.arange(0, matches.num_lines, each))

    def fitted(lens: FreeLens | None) -> tuple[OnePose, QueryCamera]:
        return fit_to_near(refined.camera, some, refined.pose, max_error, lens, gathered)

    def covariance(one: OnePose, camera: QueryCamera, lens: FreeLens | None) -> FloatArray:
        """That of what was estimated of a lens."""
        found = fitted_at(one, camera, some, max_error, lens)
        joint = found.joint_covariance(some)
        if common is not None and np.isfinite(joint).all():
            joint = joint + common(found, matches, each)
        return joint[6:, 6:]

    lens, whole = (free_lens(refined.camera, unknowns) for unknowns in ("focal", "pinhole"))
    one, camera = fitted(lens)
    focal, sigma = float(_step(refined.camera, camera)[0]), np.inf
    if abs(focal) > gates.focal:
        sigma = float(np.sqrt(covariance(one, camera, lens)[0, 0]))
    if not gathered or not camera.kind.principal_point_indices:
        return LensStep(focal, sigma)
    if not _may_be_far(fitted_at(one, camera, some, max_error, whole), 0.5 * gates.shift):
        return LensStep(focal, sigma)
    one, camera = fitted(whole)
    step = _step(refined.camera, camera)
    shift = float(np.linalg.norm(step[1:]))
    uncertain = covariance(one, camera, whole) if shift > gates.shift else np.full((3, 3), np.inf)
    if not np.isfinite(uncertain).all():
        return LensStep(focal, sigma)
    return LensStep(focal, sigma, shift, float(step @ np.linalg.solve(uncertain, step)))


def _one_step(refined: Refined, matches: Matches) -> tuple[float, float]:
    """How far one step by all that is near moves focal length and principal point, focal lengths."""
    one, weights = refined.one, refined.weights
    if not all(part.has_lens for part in one.parts):  # segments without the distortion of the lens that was given
        one = problem_of(refined.camera, matches, refined.pose, True)
        weights = weighed(one, matches)[0]
    lens = free_lens(refined.camera, "pinhole")
    step = None if lens is None else full_step(one, weights, Cauchy(REFINEMENT.wide_loss), lens)
    return (np.inf, np.inf) if step is None else (float(step[6]), float(np.linalg.norm(step[7:])))


def _step(given: QueryCamera, found: QueryCamera) -> FloatArray:
    """Steps (3,) of focal length and principal point, from those of the lens that was given."""
    kind, focal = found.kind, found.kind.focal_length(given.params)
    center = (found.params - given.params)[list(kind.principal_point_indices)] / focal
    return np.append(np.log(kind.focal_length(found.params) / focal), center)


def _may_be_far(here: Refined, limit: float) -> bool:
    """Whether one step of all unknowns, by what agrees, moves the principal point farther; or it is not determined."""
    chosen = ((here.points, here.point_inliers), (here.lines, here.line_inliers))
    J = np.concatenate([found.by_pose[kept] for found, kept in chosen]).reshape(-1, 9)
    r = np.concatenate([found.value[kept] for found, kept in chosen]).ravel()
    return not np.linalg.norm(np.linalg.lstsq(J, r)[0][7:]) <= limit
