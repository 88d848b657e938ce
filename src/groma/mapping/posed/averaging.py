# SPDX-License-Identifier: BSD-3-Clause
r"""Poses that agree with motions between pairs of images and with the poses that were given.

**Rotations.** With :math:`R_i` the rotation of camera i from the world and increments :math:`R_i \exp(\delta_i)`,

.. math:: \min \sum_{ij} \rho\!\left(\frac{\lVert R_j^\top \log(R_j R_i^\top R_{ij}^\top) + \delta_j - \delta_i\rVert}
          {\sigma_{ij}}\right) + \sum_i \rho\!\left(\frac{\lVert \log(\bar R_i^\top R_i) + \delta_i \rVert}{s}\right) .

**Centres**, with the rotations held and :math:`u` the direction of a motion in the world,

.. math:: \min \sum_{ij} \rho\!\left(\frac{\lVert (I - u u^\top)(c_i - c_j) \rVert}{\lVert c_i - c_j\rVert\,\sigma_{ij}}
          \right) + \sum_i \rho\!\left(\frac{\lVert c_i - \bar c_i \rVert}{s}\right) .

Both are solved by reweighting: first Huber's loss, which a minority of wrong motions or poses cannot bend, then
Geman and McClure's, which lets go of them. The noise s of the given poses is estimated on the way from the median of
their residuals, each divided by its redundancy: what is left of a pose's own error after it took part.

References
----------
A. Chatterjee, V. Govindu, *Robust relative rotation averaging*, 2018. O. Ozyesil, A. Singer, *Robust camera location
estimation by convex programming*, 2015. W. Foerstner, B. Wrobel, *Photogrammetric computer vision*, 2016, eq. (4.87),
for redundancy numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import SuperLU, splu

from groma._typing import BoolArray, FloatArray, IntArray
from groma.gates import NORMAL, chi_square_gate, gate
from groma.geometry import quaternion
from groma.mapping.posed.motions import Motions
from groma.mapping.posed.noise import GROSS_ERRORS

#: Columns of an inverse that are computed at a time (cost: memory).
_COLUMNS = 256


@dataclass(frozen=True)
class AveragingGates:
    """How motions and given poses are weighed against each other."""

    steps: int = gate(15, "steps", "under each of the two losses", "cost: converged before")
    noise_steps: int = gate(3, "steps", "after which the noise is estimated again", "cost: it needs an inverse")
    odd: float = gate(3.0, "ratio", "to the median disagreement, to start elsewhere", "convention: three")
    nearest: float = gate(0.5, "share", "of the distance of two images with a parallax", "convention: a half")


GATES = AveragingGates()


@dataclass(frozen=True, eq=False)
class Averaged:
    """One kind of quantities that agree with motions and given values."""

    #: (N, 4) rotations of the cameras from the world, or (N, 3) centres.
    values: FloatArray
    #: (N, 3) differences from the given ones.
    residual: FloatArray
    #: Standard deviation of a coordinate of the given ones.
    sigma: float
    #: (N,) redundancy of each given one, and (E,) weight that each motion was left with, from 0 to 1.
    redundancy: FloatArray
    kept: FloatArray


#: Differences of motions, of given values, and the lengths by which the former are divided.
_Residuals = Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]
#: From values and weights of motions and of given ones: new values and the factors of the normal matrix.
_Solved = Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, SuperLU]]
_Loss = Callable[[FloatArray], FloatArray]


def average_rotations(given: FloatArray, motions: Motions) -> Averaged:
    """Return rotations (N, 4) that agree with motions and with given ones."""
    first, second, counts = motions.first, motions.second, np.ones(len(given), bool)

    def residuals(now: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        between = quaternion.multiply(now[second], quaternion.conjugate(now[first]))
        off = quaternion.log(quaternion.multiply(between, quaternion.conjugate(motions.rotation)))
        in_world = quaternion.rotate(quaternion.conjugate(now[second]), off)
        return in_world, quaternion.log(quaternion.multiply(quaternion.conjugate(given), now)), np.ones(len(first))

    def solved(now: FloatArray, weight: FloatArray, prior: FloatArray) -> tuple[FloatArray, SuperLU]:
        off, own, _ = residuals(now)
        system, right = splu(_laplacian(first, second, weight, prior)), -prior[:, None] * own
        np.add.at(right, second, -weight[:, None] * off)
        np.add.at(right, first, weight[:, None] * off)
        return quaternion.multiply(now, quaternion.exp(system.solve(right))), system

    found = _reweighted(_voted(given, motions), residuals, solved, motions.rotation_sigma, counts, _huber)
    return _reweighted(found.values, residuals, solved, motions.rotation_sigma, counts, _geman_mcclure, found.sigma)


def average_centers(given: FloatArray, rotations: FloatArray, motions: Motions, held: BoolArray) -> Averaged:
    """Return centres (N, 3) that agree with motions and with given ones; those not ``held`` are known to be wrong."""
    first, second = motions.first, motions.second
    direction = quaternion.rotate(quaternion.conjugate(rotations[second]), motions.direction)
    least = 1e-3 * float(np.median(np.linalg.norm(given[first] - given[second], axis=1))) + 1e-12

    def averaged(start: FloatArray, loss: _Loss, sigma: float | None) -> Averaged:
        # Lengths are fixed during a stage: else places far away, where every angle is small, would fit.
        length = np.maximum(np.linalg.norm(start[first] - start[second], axis=1), least)
        # Images at one place would agree with any motion: no two come nearer than this, if their places are known.
        nearest = GATES.nearest * (length * (held[first] & held[second]))[:, None]

        def residuals(centers: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            between = centers[first] - centers[second]
            along = np.einsum("ij,ij->i", between, direction)[:, None]
            return (between - np.maximum(along, nearest) * direction) / length[:, None], centers - given, length

        def solved(centers: FloatArray, weight: FloatArray, prior: FloatArray) -> tuple[FloatArray, SuperLU]:
            ahead = np.einsum("ij,ij->i", centers[first] - centers[second], direction) > nearest[:, 0]
            along = np.where(ahead, 1.0, 0.0)[:, None, None] * direction[:, :, None] * direction[:, None, :]
            weight = weight / length**2
            system = splu(_block_laplacian(first, second, weight[:, None, None] * (np.eye(3) - along), prior))
            right, pushed = prior[:, None] * given, (weight * ~ahead)[:, None] * nearest * direction
            np.add.at(right, first, pushed)
            np.add.at(right, second, -pushed)
            new = system.solve(right.ravel()).reshape(-1, 3)
            return _as_large(new, given, prior), system

        return _reweighted(start, residuals, solved, motions.direction_sigma, held, loss, sigma)

    found = averaged(_crossed(given, direction, motions, held), _huber, None)
    return averaged(found.values, _geman_mcclure, found.sigma)


def _reweighted(
    values: FloatArray,
    residuals: _Residuals,
    solved: _Solved,
    sigma: FloatArray,
    counts: BoolArray,
    loss: _Loss,
    noise: float | None = None,
) -> Averaged:
    """Solve by reweighting under a loss, from ``values`` on; ``noise`` is that of the given ones, if it is known."""
    redundancy, kept = np.ones(len(values)), np.ones(len(sigma))
    off, own, length = residuals(values)
    if noise is None:
        noise = max(float(np.median(np.linalg.norm(own[counts], axis=1))), 1e-9) if counts.any() else 1.0
    for step in range(1, GATES.steps + 1):
        ratio = np.linalg.norm(off, axis=1) / sigma
        # Of repeated structure most motions are wrong (convention: the quartile, not the median).
        spread = max(1.0, float(np.sqrt(np.quantile(ratio**2, 0.25) / chi_square_gate(0.75, 3))))
        # A pose that claims to be far better than the motions would outvote any number of them.
        used = max(noise, spread * float(np.median(sigma * length)))
        kept = loss(ratio / spread)
        trust = np.where(counts, loss(np.linalg.norm(own, axis=1) / used), 1e-6)
        values, system = solved(values, kept / (spread * sigma) ** 2, trust / used**2)
        off, own, length = residuals(values)
        if step % GATES.noise_steps:
            continue
        redundancy = np.clip(1.0 - trust / used**2 * _inverse_diagonal(system, len(values)), 0.0, 1.0)
        counted = counts & (redundancy > GROSS_ERRORS.least_redundancy)
        if 2 * counted.sum() > counts.sum():  # else the given ones are too good for motions to show their noise
            squares = np.sum(own[counted] ** 2, axis=1) / redundancy[counted]
            noise = max(float(np.sqrt(np.median(squares) / chi_square_gate(0.5, 3))), 1e-9)
    return Averaged(values, own, noise, redundancy, kept)


def _inverse_diagonal(system: SuperLU, count: int) -> FloatArray:
    """Return the mean of the diagonal of the inverse over the coordinates of each of ``count`` quantities."""
    size = system.shape[0]
    parts = []
    for start in range(0, size, _COLUMNS):
        rows = np.arange(start, min(start + _COLUMNS, size))
        unit = np.zeros((size, len(rows)))
        unit[rows, rows - start] = 1.0
        parts.append(system.solve(unit)[rows, rows - start])
    return np.concatenate(parts).reshape(count, -1).mean(axis=1)


def _huber(ratio: FloatArray) -> FloatArray:
    return 1.0 / np.maximum(ratio, 1.0)


def _as_large(centers: FloatArray, given: FloatArray, weight: FloatArray) -> FloatArray:
    """Return centres at the scale of the given ones: motions have none, and wrong ones shrink everything."""
    share = (weight / weight.sum())[:, None]
    middle, of_given = np.sum(share * centers, axis=0), np.sum(share * given, axis=0)
    around = centers - middle
    size = np.sum(share * around * around)
    scale = np.sum(share * around * (given - of_given)) / size if size > 0.0 else 1.0
    return of_given + (scale if scale > 0.0 else 1.0) * around


def _geman_mcclure(ratio: FloatArray) -> FloatArray:
    return 1.0 / (1.0 + (ratio / NORMAL.mistake) ** 2) ** 2


def _laplacian(first: IntArray, second: IntArray, weight: FloatArray, prior: FloatArray) -> csc_array:
    rows = np.concatenate([first, second, first, second, np.arange(len(prior))])
    columns = np.concatenate([first, second, second, first, np.arange(len(prior))])
    values = np.concatenate([weight, weight, -weight, -weight, prior])
    return csc_array(coo_array((values, (rows, columns)), (len(prior), len(prior))))


def _block_laplacian(first: IntArray, second: IntArray, blocks: FloatArray, prior: FloatArray) -> csc_array:
    own = prior[:, None, None] * np.eye(3)
    every = np.arange(len(prior))
    row = np.concatenate([first, second, first, second, every])
    column = np.concatenate([first, second, second, first, every])
    values = np.concatenate([blocks, blocks, -blocks, -blocks, own])
    rows = (3 * row[:, None, None] + np.arange(3)[:, None]) + np.zeros((1, 1, 3), int)
    columns = (3 * column[:, None, None] + np.arange(3)[None, :]) + np.zeros((1, 3, 1), int)
    size = 3 * len(prior)
    return csc_array(coo_array((values.ravel(), (rows.ravel(), columns.ravel())), (size, size)))


def _voted(given: FloatArray, motions: Motions) -> FloatArray:
    """Return for each image the rotation nearest to all that its neighbours and its own pose propose."""
    rotations = given
    for _ in range(2):
        proposed = [[rotation] for rotation in rotations]
        onto = quaternion.multiply(motions.rotation, rotations[motions.first])
        back = quaternion.multiply(quaternion.conjugate(motions.rotation), rotations[motions.second])
        for row, one in zip([*motions.second, *motions.first], [*onto, *back], strict=True):
            proposed[row].append(one)
        rotations = np.array([_median_rotation(np.array(some)) for some in proposed])
    return rotations


def _median_rotation(proposed: FloatArray) -> FloatArray:
    apart = 2.0 * np.arccos(np.clip(np.abs(proposed @ proposed.T), 0.0, 1.0))
    return proposed[int(apart.sum(axis=1).argmin())]


def _crossed(given: FloatArray, direction: FloatArray, motions: Motions, held: BoolArray) -> FloatArray:
    """Return centres, those that contradict their neighbours moved to where the directions from these cross."""
    centers, rays, off = given.copy(), [], np.full(len(given), np.nan)
    ends = ((motions.first, motions.second, direction), (motions.second, motions.first, -direction))
    for row in range(len(given)):
        others = np.concatenate([other[own == row] for own, other, _ in ends])
        ways = np.concatenate([way[own == row] for own, _, way in ends])
        rays.append((given[others[held[others]]], ways[held[others]]))
        if len(rays[row][0]) >= 2:
            off[row] = _disagreement(given[row], *rays[row])
    # Few rays always cross somewhere: only what disagrees more than others is moved.
    usual = np.nanmedian(off) if np.isfinite(off).any() else 0.0
    for row in np.flatnonzero(np.isfinite(off) & (~held | (off > GATES.odd * usual))).tolist():
        crossing = _intersection(*rays[row])
        if _disagreement(crossing, *rays[row]) < 0.5 * off[row]:
            centers[row] = crossing
    return centers


def _intersection(at: FloatArray, way: FloatArray) -> FloatArray:
    """Return the point nearest to half-lines, by reweighting."""
    blocks = np.eye(3) - way[:, :, None] * way[:, None, :]
    weight, point = np.ones(len(at)), at.mean(axis=0)
    for _ in range(10):
        normal = np.einsum("i,ijk->jk", weight, blocks)
        normal += 1e-9 * np.trace(normal) * np.eye(3)
        point = np.linalg.solve(normal, np.einsum("i,ijk,ik->j", weight, blocks, at))
        weight = 1.0 / np.maximum(np.linalg.norm(np.einsum("ijk,ik->ij", blocks, point - at), axis=1), 1e-9)
        weight /= weight.max()
    return point


def _disagreement(point: FloatArray, at: FloatArray, way: FloatArray) -> float:
    """Return the median angle between directions and those to a point."""
    between = point - at
    size = np.maximum(np.linalg.norm(between, axis=1), 1e-12)
    return float(np.median(np.arccos(np.clip(np.einsum("ij,ij->i", between, way) / size, -1.0, 1.0))))
