# SPDX-License-Identifier: BSD-3-Clause
r"""Motions of a few matches, in closed form.

*Rigid motions and similarities* of three matches. Two of their directions, of lines or from point to point, give the
rotation; lines have no sign, so each combination of signs is a proposal. Scale and translation then solve

.. math:: N_i^\top (s\,R\,a_{ik} + t) = N_i^\top b_i \text{ (lines)}, \qquad s\,R\,a_i + t = b_i \text{ (points)}.

*Projective motions* of five matches: the same equations are linear in the entries of :math:`H`. For lines they say
that the dual Plücker matrix of the second takes the moved ends of the first to zero, :math:`L_b^* H a = 0`, which is
the line motion matrix's equation without its 36 unknowns.

Reference: A. Bartoli, P. Sturm, *The 3D line motion matrix and alignment of line reconstructions*, 2004, section 4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.estimators.motion.groups import Kind
from groma.estimators.motion.matches import Prepared

#: Matches that a proposal is made of.
SAMPLE: dict[str, int] = {"rigid": 3, "similarity": 3, "projective": 5}


@dataclass(frozen=True, eq=False)
class _Equations:
    """Matches as equations: moved objects, directions across which they are compared, and targets."""

    #: (n, 2, 3) ends in a, twice the same for points; (n, 2, 3, 3) rows of the comparison; (n, 3) places in b.
    moved: FloatArray
    rows: FloatArray
    place: FloatArray

    @classmethod
    def of(cls, prepared: Prepared) -> _Equations:
        matches, count = prepared.matches, len(prepared.matches)
        rows = np.zeros((count, 2, 3, 3))
        rows[: matches.num_lines, :, :2] = np.swapaxes(prepared.across, 1, 2)[:, None]
        rows[matches.num_lines :, 0] = np.eye(3)
        moved = np.concatenate([matches.lines_in_a, np.repeat(matches.points_in_a[:, None], 2, axis=1)])
        return cls(moved, rows, np.concatenate([matches.lines_in_b[:, 0], matches.points_in_b]))


def propose(prepared: Prepared, kind: Kind, count: int, rng: np.random.Generator) -> FloatArray:
    """Return motions (h, 4, 4) of random samples of the matches."""
    size, total = SAMPLE[kind], len(prepared.matches)
    samples = np.sort(rng.random((count, total)).argpartition(size - 1, axis=1)[:, :size], axis=1)
    samples = np.unique(samples, axis=0)
    equations = _Equations.of(prepared)
    found = _projective(equations, samples) if kind == "projective" else _metric(prepared, equations, samples, kind)
    return found[np.isfinite(found).all(axis=(1, 2))]


def _projective(equations: _Equations, samples: IntArray) -> FloatArray:
    ends = np.concatenate([equations.moved, np.ones((*equations.moved.shape[:2], 1))], axis=2)
    rows = np.einsum("nerx,nej->nerxj", equations.rows, ends)
    last = -np.einsum("nerx,nx,nej->nerj", equations.rows, equations.place, ends)
    design = np.concatenate([rows, last[..., None, :]], axis=3).reshape(len(ends), 6, 16)[samples]
    design = design.reshape(len(samples), 30, 16)
    found = np.linalg.eigh(np.swapaxes(design, 1, 2) @ design)[1][:, :, 0].reshape(-1, 4, 4)
    middle = ends[samples].mean(axis=(1, 2))
    return found * np.where(np.einsum("hj,hj->h", found[:, 3], middle) < 0, -1.0, 1.0)[:, None, None]


def _metric(prepared: Prepared, equations: _Equations, samples: IntArray, kind: Kind) -> FloatArray:
    rotation, of = _rotations(prepared, samples)
    chosen = samples[of]
    rows, place = equations.rows[chosen], equations.place[chosen]
    turned = np.einsum("hij,hsej->hsei", rotation, equations.moved[chosen])
    by_scale = np.einsum("hserx,hsex->hser", rows, turned)
    right = np.einsum("hserx,hsx->hser", rows, place)
    if kind == "rigid":
        design, right = rows, right - by_scale
    else:
        design = np.concatenate([rows, by_scale[..., None]], axis=-1)
    design, right = design.reshape(len(of), 18, design.shape[-1]), right.reshape(len(of), 18)
    normal, left = np.swapaxes(design, 1, 2) @ design, np.einsum("hrk,hr->hk", design, right)
    sure = np.linalg.eigvalsh(normal)[:, 0] > 1e-12
    rotation, solved = rotation[sure], np.linalg.solve(normal[sure], left[sure][..., None])[..., 0]
    scale = np.ones(len(solved)) if kind == "rigid" else solved[:, 3]
    out = np.tile(np.eye(4), (len(solved), 1, 1))
    out[:, :3, :3], out[:, :3, 3] = scale[:, None, None] * rotation, solved[:, :3]
    return out[scale > 0]


def _rotations(prepared: Prepared, samples: IntArray) -> tuple[FloatArray, IntArray]:
    """Rotations (h, 3, 3) that take two directions of each sample over, and of which sample they are."""
    matches = prepared.matches
    lines = (samples < matches.num_lines).sum(axis=1)  # come first in each sample
    pairs = []
    for ends, points in ((matches.lines_in_a, matches.points_in_a), (matches.lines_in_b, matches.points_in_b)):
        place = np.concatenate([ends.mean(axis=1), points])[samples]
        along = np.concatenate([ends[:, 1] - ends[:, 0], np.zeros_like(points)])[samples]
        first = np.where((lines > 0)[:, None], along[:, 0], place[:, 1] - place[:, 0])
        second = np.where((lines > 1)[:, None], along[:, 1], place[:, 2] - place[:, 1])
        pairs.append(np.stack([first, second], axis=1))
    a, b = (pair / np.maximum(np.linalg.norm(pair, axis=2, keepdims=True), 1e-12) for pair in pairs)
    signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    of, sign = np.divmod(np.arange(4 * len(samples)), 4)
    # Directions from point to point have no sign to be tried.
    used = ((signs[sign, 0] > 0) | (lines[of] > 0)) & ((signs[sign, 1] > 0) | (lines[of] > 1))
    of, sign = of[used], sign[used]
    frames = [np.stack([one[:, 0], one[:, 1], np.cross(one[:, 0], one[:, 1])], axis=2)
              for one in (a[of], b[of] * signs[sign][..., None])]  # fmt: skip
    u, s, vt = np.linalg.svd(frames[1] @ np.swapaxes(frames[0], 1, 2))
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    sure = s[:, 1] > 1e-6
    return (u @ vt)[sure], of[sure]
