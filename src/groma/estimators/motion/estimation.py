# SPDX-License-Identifier: BSD-3-Clause
r"""The motion between two copies of the same lines and points: found robustly, refined, and refused where it is open.

Proposals of a few matches are compared by :math:`\sum_i \min(r_i^\top C_i^{-1} r_i + \log |C_i| / |C_i^0|,\; g)`, with
the gate :math:`g` that noise exceeds once in a hundred and :math:`C^0` the covariance where segments overlap; the best
are refined by least squares on what agrees. The result is refused where

* **chance** explains it: wrong proposals agree with a share :math:`p` of the matches, and :math:`\binom{n}{m}
  \binom{n - m}{k - m} p^{k - m} \ge 1` for :math:`k` of :math:`n` that agree and samples of :math:`m`;
* **another motion** fits as well: undirected lines may have symmetries;
* **a part of it is open**: noise alone feigns some information, as parallel lines that are measured are never quite
  parallel. How much, is seen by adding the noise once more: information :math:`\Lambda` grows by about what noise had
  contributed. Where the growth :math:`\Delta` has :math:`\max_v\, v^\top \Delta\, v / v^\top \Lambda\, v` beyond a
  half, the matches do not determine :math:`v`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import eigh

from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError, check_kind, given_or_default
from groma.estimators.motion.degeneracy import what_is_common, why_open
from groma.estimators.motion.groups import FREEDOM, Kind, changed_frame, moved, tangent_between
from groma.estimators.motion.hypotheses import SAMPLE, propose
from groma.estimators.motion.matches import LandmarkMatches, Prepared
from groma.gates import NORMAL, chi_square_gate, gate
from groma.geometry import quaternion


@dataclass(frozen=True)
class MotionGates:
    """What agrees with a motion, and when it is refused."""

    proposals: int = gate(500, "samples", "of matches", "cost: linear in it")
    compared: int = gate(100, "matches", "by which proposals are compared first", "cost: linear in it")
    kept: int = gate(40, "proposals", "compared by all matches", "cost: linear in it")
    refined: int = gate(6, "proposals", "refined", "cost: linear in it")
    max_steps: int = gate(15, "steps", "of a refinement", "cost: usually five")
    longest: float = gate(10.0, "1", "norm of a step, else the refinement is given up", "cost: it has gone astray")
    converged: float = gate(1e-3, "1", "gain of chi square that ends it", "derived from the variance of a chi square")
    damped: float = gate(10.0, "times", "less damping after a step that helped, more after another", "cost: steps")
    elsewhere: float = gate(0.2, "1", "median shift of places by another motion, of their extent", "cost: of refining")
    apart: float = gate(100.0, "1", "squared distance of different motions, in sigma", "convention: ten sigma")
    feigned: float = gate(0.5, "share", "of information that noise may feign", "derived from 1 where nothing else is")
    draws: int = gate(24, "draws", "of noise that is added once more", "cost: linear in it")


@dataclass(frozen=True)
class MotionOptions:
    """Options of the estimation of motions."""

    #: Random seed of the samples.
    seed: int = 0
    gates: MotionGates = field(default_factory=MotionGates)


@dataclass(frozen=True, eq=False)
class Motion:
    """An estimated motion with its covariance."""

    kind: Kind
    #: (4, 4) b_from_a; of a projective motion with norm one.
    matrix: FloatArray
    #: (k, k) covariance of the left tangent: (rho, omega), for similarities with sigma, the logarithm of the scale;
    #: projective motions have eight more (:mod:`groma.estimators.motion.groups`).
    covariance: FloatArray
    #: (L,) and (P,) which matches agree.
    line_inliers: BoolArray
    point_inliers: BoolArray
    #: Their squared normalised residuals, and the number of these beyond what the motion takes up.
    chi_square: float
    redundancy: int

    @property
    def pose(self) -> FloatArray:
        """Pose (7,) b_from_a of a rigid motion; of a similarity the one without its scale."""
        return self.similarity[:7]

    @property
    def similarity(self) -> FloatArray:
        """Similarity (8,): quaternion, translation, scale."""
        if self.kind == "projective":
            raise InputError("A projective motion is no similarity. Use its matrix.")
        scale = np.cbrt(np.linalg.det(self.matrix[:3, :3]))
        return np.concatenate([quaternion.from_matrix(self.matrix[:3, :3] / scale), self.matrix[:3, 3], [scale]])


def estimate_motion(matches: LandmarkMatches, kind: Kind = "rigid", options: MotionOptions | None = None) -> Motion:
    """Estimate the motion between two copies of the same lines and points robustly.

    Parameters
    ----------
    matches : LandmarkMatches
        Lines alone, points alone, or both.
    kind : str
        ``rigid``, ``similarity`` or ``projective``.
    options : MotionOptions, optional
        Seed and gates.

    Returns
    -------
    Motion
        ``b_from_a``.

    Raises
    ------
    InputError
        If no motion has more than chance agreement, two have the same, or the matches leave a part of it open; the
        message says which.
    """
    check_kind(matches, LandmarkMatches, "matches", "Put the lines and points into one, row by row.")
    options = given_or_default(options, MotionOptions)
    if kind not in FREEDOM:
        raise InputError(f"kind must be one of {', '.join(FREEDOM)}; got {kind!r}.")
    if len(matches) < SAMPLE[kind]:
        raise InputError(f"A {kind} motion needs at least {SAMPLE[kind]} matches; got {len(matches)}. Pass more.")
    a, b = _normalisers(matches, kind)
    search = _Search(matches.normalised(a, b), kind, options)
    found = search.best()
    information = search.information(found, search.prepared)
    search.check_determined(found, information)
    back = np.asarray(np.linalg.inv(b), np.float64)
    motion = back @ found @ a
    if kind == "projective":
        motion *= (1.0 if motion[3] @ np.append(-a[:3, 3] / a[0, 0], 1.0) > 0 else -1.0) / np.linalg.norm(motion)
    change = changed_frame(kind, back)
    agree = search.agreeing(found)
    chi_square = float(search.prepared.squares(found)[agree].sum())
    lines = int(agree[: matches.num_lines].sum())
    redundancy = 4 * lines + 3 * int(agree.sum() - lines) - FREEDOM[kind]
    covariance = change @ np.linalg.inv(information) @ change.T
    return Motion(
        kind, motion, covariance, agree[: matches.num_lines], agree[matches.num_lines :], chi_square, redundancy
    )


def _normalisers(matches: LandmarkMatches, kind: Kind) -> tuple[FloatArray, FloatArray]:
    """Similarities (4, 4) after which most of both copies lies within a unit of the origin."""
    out = []
    for lines, points in ((matches.lines_in_a, matches.points_in_a), (matches.lines_in_b, matches.points_in_b)):
        places = np.concatenate([lines.reshape(-1, 3), points])
        center = np.median(places, axis=0)
        scale = 1.0 / max(float(np.median(np.linalg.norm(places - center, axis=1))), 1e-300)
        out.append((center, scale))
    if kind == "rigid":
        out[1] = (out[1][0], out[0][1])
    matrices = [np.eye(4), np.eye(4)]
    for matrix, (center, scale) in zip(matrices, out, strict=True):
        matrix[:3, :3], matrix[:3, 3] = scale * np.eye(3), -scale * center
    return matrices[0], matrices[1]


class _Search:
    """The search for one motion of normalised matches."""

    def __init__(self, matches: LandmarkMatches, kind: Kind, options: MotionOptions) -> None:
        self.kind: Kind = kind
        self.gates = options.gates
        self.prepared, self.rng = Prepared.of(matches), np.random.default_rng(options.seed)
        of = [chi_square_gate(NORMAL.false_alarm, 4), chi_square_gate(NORMAL.false_alarm, 3)]
        self.limit = np.repeat(of, [matches.num_lines, len(matches) - matches.num_lines])

    def agreeing(self, motion: FloatArray) -> BoolArray:
        """Which matches agree with a motion."""
        return self.prepared.squares(motion) <= self.limit

    def best(self) -> FloatArray:
        """The motion that most agrees with; refused where chance or another one explains the matches as well."""
        proposals = propose(self.prepared, self.kind, self.gates.proposals, self.rng)
        if not len(proposals):
            raise InputError(f"No {self.kind} motion: {why_open(self.prepared.matches, self.kind)}")
        some = np.sort(self.rng.permutation(len(self.limit))[: self.gates.compared])
        first = self._costs(proposals, Prepared.of(self.prepared.matches.take(some)), self.limit[some])
        proposals = proposals[np.argsort(first, kind="stable")]
        by_chance = self._share(proposals[len(proposals) // 2 :], some)
        kept = proposals[: self.gates.kept]
        second = self._costs(kept, self.prepared, self.limit)
        kept = kept[np.argsort(second, kind="stable")[: self.gates.refined]]
        refined = np.stack([self._refined(one) for one in kept])
        best = refined[self._costs(refined, self.prepared, self.limit).argmin()]
        self._check_chance(int(self.agreeing(best).sum()), by_chance)
        self._check_alone(best, proposals)
        return best

    def _costs(self, motions: FloatArray, prepared: Prepared, limit: FloatArray) -> FloatArray:
        parts = np.array_split(motions, max(1, len(motions) // 256))
        return np.concatenate([np.minimum(prepared.costs(part), limit).sum(axis=-1) for part in parts])

    def _share(self, motions: FloatArray, some: IntArray) -> float:
        """Share of some matches that agrees with proposals that are mostly wrong, those of their samples included."""
        prepared = Prepared.of(self.prepared.matches.take(some))
        chosen = motions[:: max(1, len(motions) // 200)]
        agree = (prepared.costs(chosen) <= self.limit[some]).sum(axis=-1)
        return float(max(np.mean(np.maximum(agree - SAMPLE[self.kind], 0)), 0.5) / len(some))

    def _refined(self, motion: FloatArray) -> FloatArray:
        """Least squares on what agrees, as long as that gets better."""
        damping, cost = 1e-6, self._truncated(motion)
        for _ in range(self.gates.max_steps):
            normal, right = self._normal(motion, self.prepared, self.agreeing(motion))
            scaled = normal + damping * np.diag(np.diag(normal) + 1e-12)
            step = np.asarray(-np.linalg.lstsq(scaled, right, rcond=None)[0], np.float64)
            if not np.isfinite(step).all() or np.linalg.norm(step) > self.gates.longest:
                break
            tried = moved(self.kind, motion, step)
            other = self._truncated(tried)
            if other < cost:
                gain, motion, cost, damping = cost - other, tried, other, max(damping / self.gates.damped, 1e-12)
                if gain < self.gates.converged:
                    break
            else:
                damping *= self.gates.damped
                if damping > 1.0:
                    break
        return motion

    def _truncated(self, motion: FloatArray) -> float:
        return float(np.minimum(self.prepared.squares(motion), self.limit).sum())

    def _normal(self, motion: FloatArray, prepared: Prepared, agree: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Normal equations of the tangent by the matches that agree."""
        lines = prepared.matches.num_lines
        normal, right = np.zeros((FREEDOM[self.kind],) * 2), np.zeros(FREEDOM[self.kind])
        for (r, J), rows in zip(prepared.linearised(self.kind, motion), (agree[:lines], agree[lines:]), strict=True):
            normal += np.einsum("ndk,ndl->kl", J[rows], J[rows])
            right += np.einsum("ndk,nd->k", J[rows], r[rows])
        return normal, right

    def information(self, motion: FloatArray, prepared: Prepared) -> FloatArray:
        """Information (k, k) about the tangent of what agrees."""
        return self._normal(motion, prepared, self.agreeing(motion))[0]

    def _check_chance(self, agree: int, share: float) -> None:
        total, size = len(self.limit), SAMPLE[self.kind]
        log_alarms = _log_choose(total, size) + _log_choose(total - size, agree - size) if agree > size else 0.0
        if total == size and agree == size:
            return  # no match is left to be against it
        if agree > size and log_alarms + (agree - size) * math.log(min(share, 1.0)) < 0.0:
            return
        common = what_is_common(self.prepared.matches, self.kind)
        if common:
            raise InputError(f"The matches do not determine a {self.kind} motion: {common}")
        raise InputError(
            f"No {self.kind} motion: {agree} of {total} matches agree with the best, which chance explains. Pass "
            "matches of which more are right, or a larger sigma if theirs is."
        )

    def _check_alone(self, best: FloatArray, proposals: FloatArray) -> None:
        """Refuse where one of the proposals (h, 4, 4), the best first, leads to another motion that fits as well."""
        normal, least = self.information(best, self.prepared), self._truncated(best)
        away = self.prepared.places(proposals) - self.prepared.places(best[None])
        far = proposals[np.median(np.linalg.norm(away, axis=-1), axis=-1) > self.gates.elsewhere]
        even = chi_square_gate(NORMAL.false_alarm, 2)  # twice the logarithm of the odds
        for other in [self._refined(one) for one in far[: self.gates.refined]]:
            apart = tangent_between(self.kind, best, other)
            if self._truncated(other) - least < even and apart @ normal @ apart > self.gates.apart:
                why = why_open(self.prepared.matches.take(self.agreeing(best)), self.kind)
                raise InputError(f"Two {self.kind} motions fit the matches equally well: {why}")

    def check_determined(self, motion: FloatArray, information: FloatArray) -> None:
        """Refuse a motion of which a part is known no better than noise feigns."""
        agree = self.agreeing(motion)
        matches = self.prepared.matches.take(agree)
        every = np.ones(len(matches), dtype=bool)
        again = [
            self._normal(motion, Prepared.of(matches.noisier(self.rng)), every)[0] for _ in range(self.gates.draws)
        ]
        size = np.linalg.eigvalsh(information)
        if size[0] > 1e-10 * size[-1]:
            feigned = float(eigh(np.mean(again, axis=0) - information, information, eigvals_only=True)[-1])
            if feigned <= self.gates.feigned:
                return
        raise InputError(f"The matches do not determine a {self.kind} motion: {why_open(matches, self.kind)}")


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
