# SPDX-License-Identifier: BSD-3-Clause
"""Two places that a photograph may show, and what else it may show instead."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.localization.pose.gates import VERDICT
from groma.localization.pose.hypotheses import max_errors
from groma.localization.pose.matches import Matches
from groma.localization.pose.pieces import cells_elsewhere
from groma.localization.pose.refinement import Refined, cells_of
from groma.localization.pose.verdict import (
    Evidence,
    Instead,
    Shown,
    as_good,
    pieces_of_others,
    second_site,
    site_not_in_map,
)


class Site(NamedTuple):
    """A pose: fitted to all that is near, and at that pose fitted to what was matched without it."""

    best: Refined
    used: Matches
    own: Refined
    evidence: Evidence
    #: How much of what it says is there.
    shown: Shown = Shown()

    def elsewhere(self, matches: Matches, there: FloatArray, some: BoolArray | None = None) -> int:
        """How many cells show the map elsewhere, but for those of pixels (n, 2) that show this place; by some matches
        (N,) of points, or all.
        """
        return cells_elsewhere(self.own, matches, VERDICT.distinct * max_errors(matches)[0], there, some)

    def pieces(self, matches: Matches, telling: Callable[[Matches], BoolArray] | None) -> Instead:
        """That the photograph is put together of pieces."""
        there = self.used.points2d[self.best.point_inliers]
        agree, elsewhere = self.evidence.agree, self.elsewhere(matches, there)
        if not elsewhere or telling is None:
            return pieces_of_others(agree, elsewhere, (agree, elsewhere))
        some = telling(matches)
        cells = cells_of(matches.points2d[some & self.own.point_inliers], self.best.camera, VERDICT.cells)
        counts = int(cells.max(initial=-1)) + 1, self.elsewhere(matches, there, some)
        return pieces_of_others(agree, elsewhere, counts)


def weighed(
    here: Site,
    other: tuple[Refined, Evidence] | None,
    near: Callable[[Refined], Site] | None,
    matches: Matches,
    in_map: bool,
    telling: Callable[[Matches], BoolArray] | None = None,
) -> tuple[Site, Site | None, list[Instead]]:
    """Return the more probable one of two places, the other one, and what a photograph may show instead of the first.

    Parameters
    ----------
    here
        The place that most of the matches agree with.
    other
        A pose that others of them agree with, and its evidence.
    near
        Returns the place of such a pose; None where nothing more can be matched.
    matches
        What was matched without a pose.
    in_map
        Whether these are all that a map has to say, so that a place which it does not have is told.
    telling
        Returns which matches of points show what only one place of the map has; None: all may.
    """
    agree, again = here.evidence.agree, here.elsewhere(matches, np.zeros((0, 2)))
    there, odds = None, 0.0
    if other is not None:
        again, there = max(again, other[1].agree), Site(other[0], matches, *other)
        votes, told = as_good(here.evidence, other[1]), -here.shown.log_odds
        if near is not None and votes * math.exp(min(max(told, 0.0), 600.0)) > 1.0 - VERDICT.right:
            there = near(other[0])
        odds = votes * math.exp(min(told + there.shown.log_odds, 600.0))
    unseen = site_not_in_map(agree, again, here.shown) if in_map else Instead(0.0, "")
    if near is not None and there is not None and odds > 1.0:
        here, there, odds, unseen = there, here, 1.0 / odds, unseen._replace(odds=unseen.odds / odds)
    others = [unseen, here.pieces(matches, telling)]
    if there is not None:
        others.append(second_site(here.evidence, there.evidence, odds))
    return here, there, others
