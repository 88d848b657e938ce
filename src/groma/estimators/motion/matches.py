# SPDX-License-Identifier: BSD-3-Clause
r"""Matched lines and points, their noise, and their residuals under a motion.

A line is known from a segment whose ends, :math:`a_0, a_1` and :math:`b_0, b_1`, have the standard deviation
:math:`\sigma` across it; its end points carry no information. A motion :math:`H` takes the ends of the first to
:math:`y_0, y_1`, whose offsets across the second are the four numbers in which two lines differ,

.. math:: r_k = N^\top (y_k - b_0), \quad
    \operatorname{Cov}(r_j, r_k) = \delta_{jk} \sigma_a^2\, N^\top D_k D_k^\top N
    + \sigma_b^2 \big((1 - u_j)(1 - u_k) + u_j u_k\big) I,

with :math:`N` an orthonormal basis across the second, :math:`D_k` the derivative of the motion at :math:`a_k`, and
:math:`u_k` the place of :math:`y_k` along the second, 0 at :math:`b_0` and 1 at :math:`b_1`: a line is known worse
beyond its segment. Points differ by :math:`y - b`, with :math:`\sigma_a^2 D D^\top + \sigma_b^2 I`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError, ShapeError
from groma.estimators.motion.groups import FREEDOM, Kind, generators
from groma.geometry.algebra import finite_rows

#: One standard deviation, one in a and one in b, or both of every line and of every point.
Sigma: TypeAlias = float | tuple[float, float] | tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class LandmarkMatches:
    """Lines and points in two frames, matched by row."""

    #: (L, 2, 3) segments of the same lines; their ends need not be the same, nor their directions.
    lines_in_a: FloatArray
    lines_in_b: FloatArray
    #: (P, 3) the same points.
    points_in_a: FloatArray
    points_in_b: FloatArray
    #: (L, 2) and (P, 2) standard deviations in a and in b: of ends across their line, and of points.
    line_sigma: FloatArray
    point_sigma: FloatArray

    @classmethod
    def of(
        cls,
        lines_in_a: npt.ArrayLike | None = None,
        lines_in_b: npt.ArrayLike | None = None,
        points_in_a: npt.ArrayLike | None = None,
        points_in_b: npt.ArrayLike | None = None,
        sigma: Sigma = 1.0,
    ) -> LandmarkMatches:
        """Return checked matches; ``sigma`` is one number, or one for a and one for b, or (lines, points) of those.

        Parameters
        ----------
        lines_in_a, lines_in_b : (L, 2, 3) float64, optional
            Segments of the same lines.
        points_in_a, points_in_b : (P, 3) float64, optional
            The same points.
        sigma : float or (float, float) or pair of ((L, 2), (P, 2)) float64
            Standard deviations in scene units.

        Raises
        ------
        InputError
            If rows do not match, a number is not finite, a segment is a point, or a sigma is not positive.
        """
        lines = [finite_rows(name, np.zeros((0, 2, 3)) if one is None else one, (2, 3))
                 for name, one in (("lines_in_a", lines_in_a), ("lines_in_b", lines_in_b))]  # fmt: skip
        points = [finite_rows(name, np.zeros((0, 3)) if one is None else one, (3,))
                  for name, one in (("points_in_a", points_in_a), ("points_in_b", points_in_b))]  # fmt: skip
        for kind, (first, second) in (("lines", lines), ("points", points)):
            if len(first) != len(second):
                raise ShapeError(
                    f"{kind}_in_a and {kind}_in_b must match row by row; got {len(first)} and {len(second)} rows."
                )
        for name, one in zip(("lines_in_a", "lines_in_b"), lines, strict=True):
            if len(one) and not (np.linalg.norm(one[:, 1] - one[:, 0], axis=1) > 0).all():
                raise InputError(
                    f"{name} must be segments of two different ends; got one of length zero. Leave it out."
                )
        of_lines, of_points = _sigmas(sigma, len(lines[0]), len(points[0]))
        return cls(lines[0], lines[1], points[0], points[1], of_lines, of_points)

    def __len__(self) -> int:
        return len(self.lines_in_a) + len(self.points_in_a)

    @property
    def num_lines(self) -> int:
        """Number of lines; rows of matches are lines, then points."""
        return len(self.lines_in_a)

    def take(self, rows: IntArray | BoolArray) -> LandmarkMatches:
        """Return some of the matches, lines before points."""
        rows = np.arange(len(self))[rows]
        lines, points = rows[rows < self.num_lines], rows[rows >= self.num_lines] - self.num_lines
        return LandmarkMatches(
            self.lines_in_a[lines], self.lines_in_b[lines], self.points_in_a[points], self.points_in_b[points],
            self.line_sigma[lines], self.point_sigma[points],
        )  # fmt: skip

    def normalised(self, a: FloatArray, b: FloatArray) -> LandmarkMatches:
        """Return the matches after similarities (4, 4) of both frames, without a rotation."""
        sigma = np.array([a[0, 0], b[0, 0]])
        return LandmarkMatches(
            self.lines_in_a * a[0, 0] + a[:3, 3], self.lines_in_b * b[0, 0] + b[:3, 3],
            self.points_in_a * a[0, 0] + a[:3, 3], self.points_in_b * b[0, 0] + b[:3, 3],
            self.line_sigma * sigma, self.point_sigma * sigma,
        )  # fmt: skip

    def noisier(self, rng: np.random.Generator) -> LandmarkMatches:
        """Return the matches with their own noise added once more."""
        spread = {
            name: getattr(self, name) + rng.normal(size=getattr(self, name).shape) * sigma.reshape(shape)
            for name, sigma, shape in (
                ("lines_in_a", self.line_sigma[:, 0], (-1, 1, 1)),
                ("lines_in_b", self.line_sigma[:, 1], (-1, 1, 1)),
                ("points_in_a", self.point_sigma[:, 0], (-1, 1)),
                ("points_in_b", self.point_sigma[:, 1], (-1, 1)),
            )
        }
        return replace(self, **spread)


def _sigmas(sigma: Sigma, num_lines: int, num_points: int) -> tuple[FloatArray, FloatArray]:
    if isinstance(sigma, tuple) and np.ndim(sigma[0]) == 2:
        out = np.asarray(sigma[0], float), np.asarray(sigma[1], float)
    else:
        both = np.broadcast_to(np.asarray(sigma, float), 2)
        out = np.tile(both, (num_lines, 1)), np.tile(both, (num_points, 1))
    if out[0].shape != (num_lines, 2) or out[1].shape != (num_points, 2):
        raise ShapeError(f"sigma must have shapes ({num_lines}, 2) and ({num_points}, 2); got {out[0].shape}, {out[1].shape}.")  # fmt: skip  # noqa: E501
    if not all((np.isfinite(one) & (one > 0)).all() for one in out):
        raise InputError("sigma must be positive and finite. Pass the standard deviations in scene units.")
    return out


@dataclass(frozen=True, eq=False)
class Prepared:
    """What of matches does not depend on the motion."""

    matches: LandmarkMatches
    #: (L, 3, 2) bases across the lines in b, and (L, 3) how the place along them grows.
    across: FloatArray
    along: FloatArray

    @classmethod
    def of(cls, matches: LandmarkMatches) -> Prepared:
        """Prepare matches."""
        step = matches.lines_in_b[:, 1] - matches.lines_in_b[:, 0]
        square = (step**2).sum(axis=1, keepdims=True)
        unit = step / np.sqrt(square)
        least = np.eye(3)[np.abs(unit).argmin(axis=1)] if len(unit) else np.zeros((0, 3))
        first = np.cross(unit, least)
        first = first / np.linalg.norm(first, axis=1, keepdims=True)
        return cls(matches, np.stack([first, np.cross(unit, first)], axis=2), step / square)

    def squares(self, motion: FloatArray) -> FloatArray:
        """Squared normalised residuals (L + P,) under a motion; 4 degrees of freedom for lines, 3 for points."""
        return np.concatenate([(r**2).sum(axis=-1) for r, _ in self.linearised("rigid", motion)])

    def places(self, motions: FloatArray) -> FloatArray:
        """Where motions (h, 4, 4) take the ends of segments, and points, (h, 2 L + P, 3)."""
        matches = self.matches
        return _mapped(motions[:, None], np.concatenate([matches.lines_in_a.reshape(-1, 3), matches.points_in_a]))[0]

    def costs(self, motions: FloatArray) -> FloatArray:
        """Squares (h, L + P) under motions (h, 4, 4), and the logarithms of how much less certain they are.

        Less than lines that are seen where their segments are. The two ends of a line count as independent.
        """
        matches = self.matches
        y, D = _mapped(motions[:, None, None], matches.lines_in_a)
        away = y - matches.lines_in_b[:, None, 0]
        u = (away * self.along[:, None]).sum(axis=-1)
        offset = np.einsum("lxn,hlex->hlen", self.across, away)
        of_a, of_b = (matches.line_sigma**2).T[:, :, None]
        variance = of_a * (D**2).sum(axis=(-2, -1)) / 3.0 + of_b * ((1.0 - u) ** 2 + u**2)
        lines = (offset**2).sum(axis=-1) / variance + 2.0 * np.maximum(np.log(variance / (of_a + of_b)), 0.0)
        y, D = _mapped(motions[:, None], matches.points_in_a)
        of_a, of_b = (matches.point_sigma**2).T
        variance = of_a * (D**2).sum(axis=(-2, -1)) / 3.0 + of_b
        points = ((y - matches.points_in_b) ** 2).sum(axis=-1) / variance
        points += 3.0 * np.maximum(np.log(variance / (of_a + of_b)), 0.0)  # derived from three coordinates
        return np.nan_to_num(np.concatenate([lines.sum(axis=-1), points], axis=-1), nan=np.inf)

    def linearised(self, kind: Kind, motion: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """Whitened residuals (n, d) and derivatives (n, d, k) by the tangent, of lines and of points."""
        out = []
        for offset, covariance, derivative in (self._lines(motion, kind), self._points(motion, kind)):
            size = np.einsum("...ii", covariance)[..., None, None]
            root = np.linalg.cholesky(covariance + 1e-12 * size * np.eye(offset.shape[-1]))
            both = np.linalg.solve(root, np.concatenate([offset[..., None], derivative], axis=-1))
            out.append((both[..., 0], both[..., 1:]))
        return out

    def _lines(self, motion: FloatArray, kind: Kind) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Offsets (L, 4), covariances (L, 4, 4) and derivatives (L, 4, k)."""
        matches, N, count = self.matches, self.across, len(self.across)
        y, D = _mapped(motion, matches.lines_in_a)
        away = y - matches.lines_in_b[:, None, 0]
        u = (away * self.along[:, None]).sum(axis=-1)
        seen = np.einsum("lxn,lexz->lenz", N, D)
        own = np.einsum("lenz,lemz,l->lenm", seen, seen, matches.line_sigma[:, 0] ** 2)
        place = np.stack([1.0 - u, u], axis=-1)
        theirs = np.einsum("lek,lfk,l->lef", place, place, matches.line_sigma[:, 1] ** 2)
        covariance = np.einsum("lef,nm->lenfm", theirs, np.eye(2))
        covariance[:, [0, 1], :, [0, 1]] += np.swapaxes(own, 0, 1)
        derivative = np.einsum("lxn,lexk->lenk", N, _wrt_tangent(kind, y)).reshape(count, 4, FREEDOM[kind])
        offset = np.einsum("lxn,lex->len", N, away)
        return offset.reshape(count, 4), covariance.reshape(count, 4, 4), derivative

    def _points(self, motion: FloatArray, kind: Kind) -> tuple[FloatArray, FloatArray, FloatArray]:
        matches = self.matches
        y, D = _mapped(motion, matches.points_in_a)
        covariance = np.einsum("nij,nkj,n->nik", D, D, matches.point_sigma[:, 0] ** 2)
        covariance = covariance + matches.point_sigma[:, 1, None, None] ** 2 * np.eye(3)
        return y - matches.points_in_b, covariance, _wrt_tangent(kind, y)


def _mapped(motion: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points (..., 3) after motions, and the derivative (..., 3, 3) by the points."""
    y = np.einsum("...ij,...j->...i", motion[..., :, :3], points) + motion[..., :, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        w = y[..., 3:]
        y = y[..., :3] / w
        derivative = (motion[..., :3, :3] - y[..., :, None] * motion[..., 3:, :3]) / w[..., None]
    return y, derivative


def _wrt_tangent(kind: Kind, y: FloatArray) -> FloatArray:
    """Derivatives (..., 3, k) of moved points by the tangent."""
    G = generators(kind)
    turned = np.einsum("kij,...j->...ik", G[:, :, :3], y) + G[:, :, 3].T
    return turned[..., :3, :] - y[..., :, None] * turned[..., 3:, :]
