# SPDX-License-Identifier: BSD-3-Clause
"""Lines with the segments that observe them: a value, of which every step of mapping makes a new one.

Observations of all lines are flat arrays, stored by line: those of line n are ``pointers[n] : pointers[n + 1]``.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from groma._rows import pointers_of
from groma._typing import BoolArray, FloatArray, IntArray
from groma.estimators.line_ends import SegmentRays, trim
from groma.execution import map_in_threads, map_ranges
from groma.gates import LINE_MAPS, gate
from groma.mapping.groups import grouped
from groma.mapping.lines.gates import AGREEMENT
from groma.mapping.lines.linking.fit import fit_lines
from groma.mapping.lines.outcomes import Outcome
from groma.mapping.lines.views import LineViews

#: Observations that one piece of work goes through (cost: time only).
_ROWS_AT_ONCE = 8192


@dataclass(frozen=True)
class TrackGates:
    """Which segments observe a line, and which lines are one."""

    fitting_rounds: int = gate(3, "rounds", "of fitting a line and testing observations", "cost: most is in the first")

    min_overlap_px: float = gate(5.0, "px", "shortest projection of a line, and overlap with a segment", LINE_MAPS)
    min_common_images: int = gate(2, "images", "images that show that two lines are one", LINE_MAPS)
    min_observations: int = gate(4, "observations", "of a line that tells the noise", "derived from two of four left")
    min_residuals: int = gate(30, "observations", "fewer tell nothing of the noise", "derived from 10 % of its error")
    noise_quantile: float = gate(0.75, "quantile", "of residuals, over normal ones", LINE_MAPS + ": tails are heavy")


@dataclass(frozen=True, eq=False)
class Tracks:
    """Lines and the segments that observe them. Nothing changes one; each method returns another."""

    views: LineViews
    #: (S,) line of each segment, -1 for none.
    line_of: IntArray
    #: (S,) the :class:`Outcome` of each segment without a line: why it has none.
    rejection: IntArray
    #: (S,) whether the segment's own place linked it to others; the rest are found by projecting lines.
    linked: BoolArray
    #: (S,) standard deviation across the segment, pixels: as measured, scaled, and enlarged where lines were merged.
    sigma: FloatArray
    #: (S,) squared distances over sigma of each observation to its line; NaN for segments that never had one.
    squared: FloatArray
    #: (L, 2, 3) two points of each line, its ends.
    lines: FloatArray
    #: (L,) largest standard deviation of the end points across the line.
    uncertainty: FloatArray
    #: (L,) the same without the image that tells most: what a wrong match in one image could hide behind.
    unchecked: FloatArray
    #: (L,) lines whose observations, or their noise, are not those that they were last fitted to.
    stale: BoolArray
    gates: TrackGates = field(default_factory=TrackGates)

    @staticmethod
    def none(views: LineViews, rejection: IntArray) -> Tracks:
        """No lines yet."""
        count = len(views.image_idx)
        return Tracks(
            views=views,
            line_of=np.full(count, -1, np.int64),
            rejection=rejection,
            linked=np.zeros(count, bool),
            sigma=views.sigma,
            squared=np.full(count, np.nan),
            lines=np.zeros((0, 2, 3)),
            uncertainty=np.zeros(0),
            unchecked=np.zeros(0),
            stale=np.zeros(0, bool),
        )

    @property
    def num_lines(self) -> int:
        """Number of lines."""
        return len(self.lines)

    def members(self) -> tuple[IntArray, IntArray]:
        """Rows of the segments that observe a line, and the line of each."""
        rows = np.flatnonzero(self.line_of >= 0)
        return rows, self.line_of[rows]

    def table(self) -> tuple[IntArray, IntArray]:
        """Rows of the observations by line, and the pointers of each line's."""
        rows, line = self.members()
        order, pointers = grouped(line, self.num_lines)  # rows are sorted by image, and stay so per line
        return rows[order], pointers

    def num_images(self) -> IntArray:
        """(L,) number of images of each line."""
        rows, _ = self.table()
        line, image = self.line_of[rows], self.views.image_idx[rows]
        is_new = np.ones(len(rows), bool)
        is_new[1:] = (line[1:] != line[:-1]) | (image[1:] != image[:-1])
        return np.bincount(line[is_new], minlength=self.num_lines)

    def lines_near_images(self, neighbors: list[IntArray]) -> list[IntArray]:
        """Lines to look for in each image: those seen in it or in a neighbour."""
        rows, line = self.members()
        begin = np.searchsorted(rows, self.views.pointers).tolist()

        def near(i: int) -> IntArray:
            looked_for = np.zeros(self.num_lines, bool)
            for j in (i, *neighbors[i].tolist()):
                looked_for[line[begin[j] : begin[j + 1]]] = True
            return np.flatnonzero(looked_for)

        return map_in_threads(near, range(len(neighbors)))

    def direction(self) -> FloatArray:
        """(L,) +1 or -1: whether most observations run from the first end point to the second in the image."""
        views = self.views
        rows, line = self.members()
        along = np.empty(len(rows))

        def fill(part: slice) -> None:
            own = rows[part]
            P, X = views.camera[views.image_idx[own]], self.lines[line[part]]
            x = np.einsum("mij,mkj->mki", P[:, :, :3], X) + P[:, None, :, 3]
            x = x[..., :2] / x[..., 2:]
            along[part] = ((x[:, 1] - x[:, 0]) * (views.ends[own, 2:] - views.ends[own, :2])).sum(-1)

        map_ranges(fill, len(rows), _ROWS_AT_ONCE)
        return np.sign(np.bincount(line, weights=np.sign(along), minlength=self.num_lines))

    def with_groups(self, members: IntArray, representative: IntArray, ends: FloatArray) -> Tracks:
        """Return the tracks with a new line for each group of segments.

        ``ends`` (S, 2, 3) are the segments in space; the representative's are the line's first.
        """
        chosen, group = np.unique(representative, return_inverse=True)
        line_of, linked = self.line_of.copy(), self.linked.copy()
        line_of[members], linked[members] = self.num_lines + group, True
        unknown = np.zeros(len(chosen))
        return replace(
            self, line_of=line_of, linked=linked, lines=np.concatenate([self.lines, ends[chosen]]),
            uncertainty=np.append(self.uncertainty, unknown), unchecked=np.append(self.unchecked, unknown),
            stale=np.append(self.stale, unknown == 0.0),
        )  # fmt: skip

    def observed_by(self, line_of: IntArray) -> Tracks:
        """Return the tracks with other lines (S,) of the segments."""
        stale, changed = self.stale.copy(), line_of != self.line_of
        for one in (line_of[changed], self.line_of[changed]):
            stale[one[one >= 0]] = True
        return replace(self, line_of=line_of, stale=stale)

    def with_sigma(self, sigma: FloatArray) -> Tracks:
        """Return the tracks with other standard deviations (S,) of the segments."""
        rows, line = self.members()
        stale = self.stale.copy()
        stale[line[sigma[rows] != self.sigma[rows]]] = True
        return replace(self, sigma=sigma, stale=stale)

    def refined(self, min_images: int = 2) -> Tracks:
        """Return the lines at maximum likelihood, without observations that do not fit and lines of too few images.

        Lines that have the observations they were last fitted to stay as they are.
        """
        views = self.views
        rows, pointers = self.table()
        line = self.line_of[rows]
        active, squared = np.ones(len(rows), bool), self.squared[rows]
        lines, uncertainty, unchecked = self.lines.copy(), self.uncertainty.copy(), self.unchecked.copy()
        seen = SegmentRays(views.center, views.image_idx, views.ray, views.length)
        stale = self.stale
        for k in range(self.gates.fitting_rounds):
            which, here = np.flatnonzero(stale), stale[line]
            mine, ends = rows[here], pointers_of(np.diff(pointers)[which])
            fit = fit_lines(views, self.sigma, ends, mine, active[here], lines[which])
            squared[here], uncertainty[which], unchecked[which] = fit.squared, fit.uncertainty, fit.unchecked
            lines[which], front = trim(seen, ends, mine, active[here], fit.X)
            fits = (fit.squared < AGREEMENT.max_squared(2)) & front
            if k == self.gates.fitting_rounds - 1:
                fits &= active[here]
            changed = fits != active[here]
            active[here] = fits
            stale = np.bincount(line[here][changed], minlength=self.num_lines) > 0
            if not changed.any():
                break
        distances, line_of, rejection = self.squared.copy(), self.line_of.copy(), self.rejection.copy()
        distances[rows] = squared
        line_of[rows[~active]], rejection[rows[~active]] = -1, Outcome.OUTLIER
        fitted = replace(
            self, line_of=line_of, rejection=rejection, squared=distances, lines=lines, uncertainty=uncertainty,
            unchecked=unchecked, stale=stale,
        )  # fmt: skip
        return fitted.keep(fitted.num_images() >= min_images, Outcome.FEW_IMAGES)

    def keep(self, kept: BoolArray, rejection: Outcome) -> Tracks:
        """Return some of the lines (L,); the segments of the others have no line, for this reason."""
        if kept.all():
            return self
        number = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)  # the last one stands for no line
        line_of = number[self.line_of]
        reasons = np.where((self.line_of >= 0) & (line_of < 0), rejection, self.rejection)
        return replace(
            self, line_of=line_of, rejection=reasons, lines=self.lines[kept], uncertainty=self.uncertainty[kept],
            unchecked=self.unchecked[kept], stale=self.stale[kept],
        )  # fmt: skip

    def joined(self, alias: IntArray, deviation: FloatArray) -> Tracks:
        """Return the tracks with the segments of line n, with ``deviation[n]`` more noise, on line ``alias[n]``."""
        rows, line = self.members()
        sigma, line_of = self.sigma.copy(), self.line_of.copy()
        sigma[rows], line_of[rows] = np.hypot(sigma[rows], deviation[line]), alias[line]
        return self.with_sigma(sigma).observed_by(line_of).refined(min_images=1)

    def outcomes(self) -> IntArray:
        """(S,) the :class:`Outcome` of every segment."""
        mapped = np.where(self.linked, Outcome.MAPPED, Outcome.RECOVERED)
        return np.where(self.line_of >= 0, mapped, self.rejection)
