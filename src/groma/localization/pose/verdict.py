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
fall to either with the same probability; the odds of the second are what the sign test says.

**A place that the map does not have.** Where things repeat, another place may look like this one: the odds are the
share of what agrees that the map has elsewhere, too, times how likely so small a share is where half of what agrees
repeats. What tells are points that look like no other place of the map (:mod:`groma.localization.repeated`). Of
:math:`E` that are expected :math:`k` are found, at the place itself at the rate of all others, elsewhere at a share
:math:`s` of it. Where several stand beside each other they are a thing that only this place has, and :math:`s` is
small; one alone may be of a thing that repeats. Rates scatter from photograph to photograph as gamma variables of shape
:math:`a` do, so that counts are negative binomial, and the odds are divided by

.. math:: \prod s^{-k} \left(\frac{a + sE}{a + E}\right)^{a + k} .

By the same number a second pose is weighed against the first.

**Pieces.** A picture put together of pieces shows the map elsewhere in about as many cells as at the pose. So does a
building that goes on beyond the map, but by what repeats. Counted are cells of what only one place of the map has, too,
and the odds are the smaller ones. A pose is believed if it is right with high probability beside all of these.

**The rest of the image.** What is to be seen under the pose is counted part by part of the image, by how often the map
finds it again in its own images (:mod:`groma.localization.expected`). Where about as much is missing as is there, by
the same test, a piece of the place is shown, or something that is like it.

Reference: L. Moisan, B. Stival, *A probabilistic criterion to detect rigid point matches between two images and
estimate the fundamental matrix*, 2004, eq. (9), for samples of three.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from groma._counted import counted
from groma._typing import BoolArray, FloatArray
from groma.gates import chi_square_gate
from groma.localization.pose.camera import QueryCamera, seen_from
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
    #: Whether something speaks against the pose that more matches would hardly change.
    contradicted: bool = False
    #: Whether it is something that all features near the pose say, however it was found.
    settled: bool = False
    #: Whether that is another focal length than was given.
    other_focal: bool = False

    def doubted(self, why: str, probability: float = 0.5) -> Verdict:
        """The same of a pose that something else speaks against: by itself right with this probability, or even."""
        return Verdict("uncertain", self.probability * probability, f"{self.sentence} But {why}", True, True)


class Instead(NamedTuple):
    """What a photograph may show instead of the place of a pose."""

    #: Odds beside the place itself.
    odds: float
    #: Why that is, in words; and whether more matches would hardly change it.
    words: str
    contradicts: bool = False


class Shown(NamedTuple):
    """How much of what a pose says is in an image is there."""

    #: Parts of the image that show something of it, and that show nothing.
    parts: float = 0.0
    missing: float = 0.0
    #: How many points that tell the place from others are found, and how many are expected: where they stand alone, and
    #: where others are beside them.
    found: tuple[int, int] = (0, 0)
    expected: tuple[float, float] = (0.0, 0.0)

    @property
    def log_odds(self) -> float:
        """Logarithm of how much likelier so many of these are found at the place than at another that looks like it."""
        shape, total = VERDICT.scatter**-2, 0.0
        for found, expected, elsewhere in zip(self.found, self.expected, VERDICT.elsewhere, strict=True):
            rate = math.log((shape + elsewhere * expected) / (shape + expected))
            total += (shape + found) * rate - found * math.log(elsewhere)
        return total


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
    refined: Refined, covariance: FloatArray, distance: float, evidence: Evidence, others: Sequence[Instead]
) -> Verdict:
    """Say whether a pose is right.

    Parameters
    ----------
    refined, covariance
        The pose.
    distance
        Median distance of the landmarks that agree.
    evidence
        What agrees with it.
    others
        What may be shown instead.
    """
    chance = math.exp(min(evidence.log_alarms, 700.0))
    probability = 1.0 / ((1.0 + chance) * (1.0 + sum(other.odds for other in others)))
    agree = f"{counted(int(refined.point_inliers.sum()), 'points')} and " + counted(
        int(refined.line_inliers.sum()), "lines"
    )
    if chance > 1.0:
        return Verdict(
            "failed", probability, f"No pose: only {agree} agree with the best one, as may happen by chance."
        )
    if probability < VERDICT.right:
        by_chance = Instead(
            chance, f"{agree} agree, which may happen by chance once in {1 / max(chance, 1e-9) + 1:.0f}."
        )
        most = max((by_chance, *others), key=lambda other: other.odds)
        return Verdict("uncertain", probability, most.words, most.contradicts)
    sigma = np.sqrt(np.diag(covariance))
    if not (
        np.isfinite(sigma).all() and sigma[3:].max() <= VERDICT.loose and sigma[:3].max() <= VERDICT.loose * distance
    ):
        return Verdict("uncertain", probability, f"{agree} agree, but they do not determine the pose: {_open(sigma)}.")
    return Verdict("localized", probability, f"{agree} agree.")


def second_site(first: Evidence, second: Evidence, odds: float) -> Instead:
    """Return that another place of the map, which something agrees with as well, is shown."""
    words = (
        f"Two places fit about equally well: {first.agree} measurements speak for this one, {second.agree} for "
        "another. They may look alike."
    )
    return Instead(odds, words)


def pieces_of_others(agree: int, elsewhere: int, telling: tuple[int, int]) -> Instead:
    """Return that a photograph is put together of pieces, some of which show the map elsewhere; ``telling`` are the
    cells that agree, and those elsewhere, of what only one place has.
    """
    words = (
        f"{agree} measurements speak for this place, and {elsewhere} cells of the image show the map where this place "
        "does not have it: it may repeat itself, or be put together of pieces."
    )
    odds = min(float(_tail(elsewhere, agree)), float(_tail(*telling[::-1]))) if elsewhere else 0.0
    return Instead(odds, words, elsewhere > agree)


def site_not_in_map(agree: int, again: int, shown: Shown) -> Instead:
    """Return that a place is shown which the map does not have; of the cells that agree it has so many ``again``."""
    again = min(again, agree)
    odds = again / max(agree, 1) * float(_tail(again, agree - again))
    odds += 0.5 * (1.0 - VERDICT.right)  # where nothing repeats, half of what is allowed
    words = (
        f"{agree} measurements agree, of which the map has {again} elsewhere, too, and of points that look "
        f"like no other place {sum(shown.found)} are found where {sum(shown.expected):.0f} are expected: it may be "
        "another place that looks like this one."
    )
    return Instead(odds * math.exp(-min(max(shown.log_odds, -600.0), 600.0)), words, True)


def as_good(first: Evidence, second: Evidence) -> float:
    """Probability that a second pose gets so few votes of both if both are equally good."""
    return float(_tail(second.agree, first.agree))


def doubted_if_mirrored(verdict: Verdict, own: int, mirror: int) -> Verdict:
    """Return a verdict, or ``uncertain`` where of the most alike matches more are with the mirror image of a photograph
    (mirror) than with the photograph (own).
    """
    if mirror <= own:
        return verdict
    return verdict.doubted(
        f"its mirror image fits about as well, and {mirror} of its matches are as alike as {own} of the photograph: it "
        "may be mirrored."
    )


def doubted_if_missing(verdict: Verdict, shown: float, missing: float) -> Verdict:
    """Return a verdict, or ``uncertain`` where about as much of what should be seen is missing as is there.

    ``shown`` and ``missing`` are numbers of parts of the image, by what is expected in them.
    """
    from scipy.special import betainc

    chance = 1.0 - VERDICT.whole
    few = shown > missing and 0.5 ** (shown + missing - 1.0) > chance  # so few that no test could say so much
    no_more = min(2.0 * float(betainc(shown, missing + 1.0, 0.5)), 1.0) if shown > 0.0 else 1.0
    if missing < 1.0 or few or no_more <= chance:
        return verdict
    return verdict.doubted(
        f"in {missing:.0f} of {shown + missing:.0f} parts of the image where this place has points or lines none is "
        "seen: the photograph may show this place in a part only, or something like it.",
        1.0 / (1.0 + no_more),
    )


def doubted_if_other_lens(verdict: Verdict, step: LensStep, gathered: bool = True) -> Verdict:
    """Return a verdict, or ``uncertain`` where what agrees asks for a principal point far from the one that was given,
    or for another focal length: a step that is large, also beside its standard deviation.

    What was matched without the pose (not ``gathered``) must tell so small a difference as is allowed: on a wall seen
    from the front, what is like it elsewhere moves a focal length by more than is stated.
    """
    from scipy.special import chdtrc

    if step.shift > VERDICT.shift and chdtrc(3.0, step.square) < 1.0 - VERDICT.whole:  # derived from three
        return verdict.doubted(
            "they fit a principal point far from where it should be better: the photograph may be cropped, or put "
            "together of pieces."
        )
    noise = math.sqrt(chi_square_gate(1.0 - VERDICT.right, 1)) * step.focal_sigma
    if abs(step.focal) > max(VERDICT.focal, noise) and (gathered or noise <= VERDICT.focal):
        doubted = verdict.doubted(
            f"they fit a {'longer' if step.focal > 0.0 else 'shorter'} focal length better: the calibration is not "
            "that of this photograph. Pass its own, or let it be estimated (--calibration unknown)."
        )
        return replace(doubted, other_focal=True)
    return verdict


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
    return float(np.median(np.linalg.norm(seen_from(pose, places), axis=1))) if len(places) else 0.0


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
