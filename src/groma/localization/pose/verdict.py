# SPDX-License-Identifier: BSD-3-Clause
r"""Is the pose right: what agrees with it against what would by chance, and against the next best place.

**Chance.** Under a pose that is wrong a match agrees with the probability :math:`p`, the share of the image that lies
within its gate, times how much more densely the pose puts the points of all matches than they are seen: a right one
spreads them alike, a wrong one may crowd them, as where it looks along a wall. What agrees in one cell of the image
counts once, since neighbouring matches err together. Of :math:`n` cells with matches :math:`k` agree, and three of them
fix the pose. The expected number of poses that so many cells agree with by chance is at most

.. math:: \text{NFA} = (n - 3) \binom{n}{k} \binom{k}{3}\, p^{\,k-3} .

For lines, each a cell of its own with all segments that it may have, :math:`p` is the share of the places within the
reach of a search.

**Another place.** Matches that disagree are searched for a second pose. Where one is found that chance does not
explain, :math:`k_1` cells speak for the first and :math:`k_2` for the second. If both were equally good, each would
fall to either with the same probability; the first is the right one with the probability that the sign test says.

**The rest of the image.** What is to be seen under the pose is counted part by part of the image, by how often the map
finds it again in its own images (:mod:`groma.localization.expected`). Where about as much is missing as is there, by
the same test, a piece of the place is shown, or something that is like it. So it is with points that are told from all
other places of the map: where what repeats is found and they are not, another place that looks like this one is shown.
Where they are found, this place is shown, though others fit as well, and parts that are there would fit elsewhere, too.

Reference: L. Moisan, B. Stival, *A probabilistic criterion to detect rigid point matches between two images and
estimate the fundamental matrix*, 2004, eq. (9), for samples of three.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from groma._counted import counted
from groma._typing import BoolArray, FloatArray
from groma.gates import NORMAL, chi_square_gate
from groma.geometry import se3
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.gates import VERDICT
from groma.localization.pose.lens import LensStep
from groma.localization.pose.matches import Matches
from groma.localization.pose.refinement import Refined, cells_of

Status = Literal["localized", "uncertain", "failed"]


@dataclass(frozen=True)
class Evidence:
    """How much agrees with a pose, and how often that would happen by chance."""

    #: Cells and segments that agree, of those that have matches.
    agree: int
    of: int
    #: Natural logarithm of the expected number of poses that so much agrees with by chance.
    log_alarms: float

    @property
    def significant(self) -> bool:
        """Whether less than one such pose is expected by chance."""
        return self.log_alarms < 0.0


@dataclass(frozen=True)
class Verdict:
    """What is said of a pose."""

    status: Status
    #: That the place is right.
    probability: float
    sentence: str


class Shown(NamedTuple):
    """How much of what a pose says is in an image is there."""

    #: Parts of the image that show something of it, and that show nothing.
    parts: float
    missing: float
    #: How often points that look like no other place are found at least, as a share of how often all are; NaN where the
    #: place has no such points.
    alone: float = math.nan
    #: How many points that tell the place from others are found, and how many are expected.
    found: int = 0
    expected: float = 0.0

    @property
    def known(self) -> bool:
        """Whether what only this place has is surely there."""
        return at_least(self.found, self.expected) >= VERDICT.known

    def is_known_beside(self, other: Shown) -> bool:
        """Whether what only this place has is surely there, and more often than what only another has is."""
        from scipy.special import bdtrc

        share = self.expected / max(self.expected + other.expected, 1e-12)
        chance = bdtrc(self.found - 1, self.found + other.found, share) if self.found else 1.0
        return self.known and chance <= NORMAL.false_alarm


def at_least(found: int, expected: float) -> float:
    """How much of what is expected is there at least; NaN where that is hardly anything.

    It is the lower limit of the mean of a Poisson variable, at ``NORMAL.false_alarm`` (Garwood 1936).
    """
    from scipy.special import gammaincinv

    if expected < VERDICT.expected:
        return math.nan
    return float(gammaincinv(found, NORMAL.false_alarm)) / expected if found else 0.0


def evidence_of(refined: Refined, matches: Matches, places: int = 1) -> Evidence:
    """Return the evidence for a pose that was looked for in so many places."""
    camera = refined.camera
    gate = math.pi * refined.limit * refined.points.spread * _crowding(refined, matches)
    by_chance = np.minimum(gate / camera.area, 0.5)
    agree, chance = _by_cell(matches.points2d, refined.point_inliers, by_chance, camera, VERDICT.cells)
    reach = (VERDICT.search_share * max(camera.width, camera.height)) ** 2
    by_chance = np.minimum(math.pi * refined.limit * refined.lines.spread / reach, 0.5)
    line = np.unique(matches.segments3d.reshape(-1, 6), axis=0, return_inverse=True)[1].ravel()
    line_agree, line_chance = _joined(line, refined.line_inliers, by_chance)
    agree, chance = np.concatenate([agree, line_agree]), np.concatenate([chance, line_chance])
    n, k = len(agree), int(agree.sum())
    if k <= 3:  # derived from three matches that fix a pose
        return Evidence(k, n, math.inf)
    mean = _mean_logarithm(chance, len(chance) - len(line_chance))[agree]
    spent = np.sort(mean)[:3]  # those that say most were used up
    total = math.log(max(n - 3, 1)) + _log_choose(n, k) + _log_choose(k, 3) + math.log(places)
    return Evidence(k, n, total + float(mean.sum() - spent.sum()))


def judge(
    refined: Refined, covariance: FloatArray, distance: float, first: Evidence, second: Evidence | None
) -> Verdict:
    """Say whether a pose is right.

    Parameters
    ----------
    refined, covariance
        The pose.
    distance
        Median distance of the landmarks that agree.
    first, second
        Evidence for it, and for another place.
    """
    chance = 1.0 / (1.0 + math.exp(min(first.log_alarms, 700.0)))
    rival = _as_good(first, second)
    probability = chance * (1.0 - rival)
    agree = f"{counted(int(refined.point_inliers.sum()), 'points')} and " + counted(
        int(refined.line_inliers.sum()), "lines"
    )
    if chance < NORMAL.majority:
        return Verdict(
            "failed", probability, f"No pose: only {agree} agree with the best one, as may happen by chance."
        )
    if second is not None and fits_as_well(first, second):
        return Verdict(
            "uncertain",
            probability,
            f"Two places fit about equally well: {first.agree} measurements speak for this one, {second.agree} for "
            "another. They may look alike.",
        )
    if probability < VERDICT.right:
        return Verdict(
            "uncertain",
            probability,
            f"{agree} agree, which may happen by chance once in {1 / max(1 - chance, 1e-9):.0f}.",
        )
    sigma = np.sqrt(np.diag(covariance))
    if not (
        np.isfinite(sigma).all() and sigma[3:].max() <= VERDICT.loose and sigma[:3].max() <= VERDICT.loose * distance
    ):
        return Verdict("uncertain", probability, f"{agree} agree, but they do not determine the pose: {_open(sigma)}.")
    return Verdict("localized", probability, f"{agree} agree.")


def fits_as_well(first: Evidence, second: Evidence | None) -> bool:
    """Whether another place fits about as well."""
    return _as_good(first, second) > 1.0 - VERDICT.right


def doubted_if_mirrored(verdict: Verdict, own: int, mirror: int) -> Verdict:
    """Return a verdict, or ``uncertain`` where of the most alike matches more are with the mirror image of a photograph
    (mirror) than with the photograph (own).
    """
    if mirror <= own:
        return verdict
    words = (
        f"{verdict.sentence} But its mirror image fits about as well, and {mirror} of its matches are as alike as "
        f"{own} of the photograph: it may be mirrored."
    )
    return Verdict("uncertain", 1.0 - VERDICT.right, words)


def doubted_if_in_pieces(verdict: Verdict, agree: int, elsewhere: int) -> Verdict:
    """Return a verdict, or ``uncertain`` where about as much of the photograph shows the map elsewhere."""
    if not elsewhere or _tail(elsewhere, agree) <= 1.0 - VERDICT.right:
        return verdict
    words = (
        f"{agree} measurements speak for this place, and {elsewhere} cells of the image show the map where this place "
        "does not have it: it may repeat itself, or be put together of pieces."
    )
    return Verdict("uncertain", 1.0 - VERDICT.right, words)


def doubted_if_missing(verdict: Verdict, shown: float, missing: float) -> Verdict:
    """Return a verdict, or ``uncertain`` where about as much of what should be seen is missing as is there.

    ``shown`` and ``missing`` are numbers of parts of the image, by what is expected in them.
    """
    from scipy.special import betainc

    chance = 1.0 - VERDICT.whole
    few = shown > missing and 0.5 ** (shown + missing - 1.0) > chance  # so few that no test could say so much
    if missing < 1.0 or few or (shown > 0.0 and 2.0 * betainc(shown, missing + 1.0, 0.5) <= chance):
        return verdict
    words = (
        f"{verdict.sentence} But in {missing:.0f} of {shown + missing:.0f} parts of the image where this place has "
        "points or lines none is seen: the photograph may show this place in a part only, or something like it."
    )
    return Verdict("uncertain", 1.0 - VERDICT.right, words)


def doubted_if_repeated(verdict: Verdict, shown: Shown) -> Verdict:
    """Return a verdict, or ``uncertain`` where what only this place has is not surely found.

    That is where points that look like no other may be missing, and those that tell it from others are too few.
    """
    if verdict.status != "localized" or shown.known or not shown.alone < VERDICT.alone:
        return verdict
    words = (
        f"{verdict.sentence} But points that look like no other place may be found only {100 * shown.alone:.0f} % as "
        "often as all: the photograph may show another place that looks like this one."
    )
    return Verdict("uncertain", 1.0 - VERDICT.right, words)


def doubted_if_other_lens(verdict: Verdict, step: LensStep) -> Verdict:
    """Return a verdict, or ``uncertain`` where what agrees asks for a principal point far from the one that was given,
    or for another focal length: a step that is large, also beside its standard deviation.
    """
    from scipy.special import chdtrc

    if verdict.status != "localized":
        return verdict
    if step.shift > VERDICT.shift and chdtrc(3.0, step.square) < 1.0 - VERDICT.whole:  # derived from three
        why = (
            "a principal point far from where it should be better: the photograph may be cropped, or put together of "
            "pieces."
        )
    elif abs(step.focal) > max(VERDICT.focal, math.sqrt(chi_square_gate(1.0 - VERDICT.right, 1)) * step.focal_sigma):
        why = (
            f"a {'longer' if step.focal > 0.0 else 'shorter'} focal length better: the calibration is not that of this "
            "photograph. Pass its own, or let it be estimated (--calibration unknown)."
        )
    else:
        return verdict
    return Verdict("uncertain", 1.0 - VERDICT.right, f"{verdict.sentence} But they fit {why}")


def votes_of_a_rival(agree: int) -> int:
    """How many cells must agree with another place for it to make one with so many doubtful."""
    votes = np.arange(agree + 1)
    return int(np.argmax(_tail(votes, agree) > 1.0 - VERDICT.right))


def votes_of_a_part(votes: int, share: float) -> int:
    """How many votes a share of the matches, drawn at random, has at least if all have so many."""
    from scipy.special import bdtr

    fewer = np.arange(votes + 1)
    return int(np.argmax(bdtr(fewer, votes, share) > 1.0 - VERDICT.right))


def most_votes(matches: Matches, camera: QueryCamera) -> int:
    """How many cells and segments could agree with a pose at most: those that have matches."""
    cells = cells_of(matches.points2d, camera, VERDICT.cells)
    lines = np.unique(matches.segments3d.reshape(-1, 6), axis=0) if matches.num_lines else ()
    return int(cells.max(initial=-1)) + 1 + len(lines)


def moved(camera: QueryCamera, first: FloatArray, second: FloatArray, places: FloatArray) -> float:
    """Median way in pixels of what is seen at some places in the world, from one pose to another."""
    way = np.linalg.norm(camera.project(first, places) - camera.project(second, places), axis=1)
    return float(np.median(np.where(np.isfinite(way), way, np.inf))) if len(way) else math.inf


def median_distance(pose: FloatArray, places: FloatArray) -> float:
    """Median distance (scene units) of places in the world from a camera."""
    R_t = se3.to_matrix(pose[None])[0]
    return float(np.median(np.linalg.norm(places @ R_t[:3, :3].T + R_t[:3, 3], axis=1))) if len(places) else 0.0


def _crowding(refined: Refined, matches: Matches) -> float:
    """How much more densely a pose puts the points of all matches into the image than they are seen, at least one; with
    the areas of normal distributions.
    """
    camera = refined.camera
    pixels = camera.project(refined.pose, matches.points3d)
    inside = pixels[camera.inside(pixels)]
    if len(inside) <= 3:
        return 1.0
    filled, seen = (math.sqrt(max(float(np.linalg.det(np.cov(some.T))), 1e-12)) for some in (inside, matches.points2d))
    return max(1.0, len(inside) / len(pixels) * seen / filled)


def _by_cell(
    pixels: FloatArray, inliers: BoolArray, by_chance: FloatArray, camera: QueryCamera, cells: int
) -> tuple[BoolArray, FloatArray]:
    if not len(pixels):
        return np.zeros(0, bool), np.zeros(0)
    return _joined(cells_of(pixels, camera, cells), inliers, by_chance)


def _joined(cell, inliers: BoolArray, by_chance: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Which cells agree, and how likely some match of each would by chance."""
    count = int(cell.max()) + 1 if len(cell) else 0
    agree = np.bincount(cell, inliers, count) > 0
    none = np.bincount(cell, np.log1p(-by_chance), count)
    return agree, -np.expm1(none)


def _mean_logarithm(chance: FloatArray, points: int) -> FloatArray:
    """Logarithm of the mean probability, of points and of lines by themselves: which cells agree is not chosen."""
    mean = np.empty(len(chance))
    for part in (slice(0, points), slice(points, None)):
        if len(chance[part]):
            mean[part] = math.log(max(float(chance[part].mean()), 1e-12))
    return mean


def _as_good(first: Evidence, second: Evidence | None) -> float:
    """Probability that a second pose gets so few votes of both if both are equally good."""
    if second is None or not second.significant:
        return 0.0
    return float(_tail(np.array(second.agree), first.agree))


def _tail(fewer, more):
    """Probability that of two alike one gets so few votes or fewer."""
    from scipy.special import bdtr

    return np.minimum(1.0, 2.0 * bdtr(fewer, fewer + more, 0.5))


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)


def _open(sigma: FloatArray) -> str:
    if not np.isfinite(sigma).all():
        return "the camera could move without changing any of them"
    shift, turn = float(np.linalg.norm(sigma[:3])), float(np.rad2deg(np.linalg.norm(sigma[3:])))
    return f"its standard deviation is {shift:.3g} scene units and {turn:.2g} degrees"
