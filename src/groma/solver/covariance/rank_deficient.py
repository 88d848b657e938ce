# SPDX-License-Identifier: BSD-3-Clause
r"""Unobservable kept variables: how to hold them, so that all others have their covariances.

There are three sorts. Of a coordinate that landmarks follow, such as the offset of a plane on which nothing but points
seen once lie, elimination leaves rounding where S should have zeros. A direction x of one plane with
:math:`x^\top H x = 0` (two points hold it, and it can turn about them) moves no residual by itself, so it is coupled to
nothing; small matrices tell, for any number of planes. What moves only together, such as a plane and points on it that
are seen once, are modes of the reduced system whose eigenvalue is zero. Held along such directions the system can be
inverted, and what they move is reported instead of estimated. Where they move more than a few cameras, nothing is left
to refer covariances to, and that is an error.
"""

from __future__ import annotations

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.errors import ProblemError
from groma.problem.layout import Layout
from groma.problem.linearization import NormalEquations
from groma.solver.linear.blocks import Blocks
from groma.solver.linear.elimination import LANDMARK_TOLERANCE, scaled_blocks
from groma.solver.linear.fronts import Fronts
from groma.solver.linear.modes import MODES, Modes, smallest
from groma.solver.linear.schur import ReducedSystem

#: A variable that moves by more than this in a scaled mode of zero cost is loose; this share of the poses may be.
LOOSE, MAX_LOOSE = 1e-6, 0.2
#: Modes of zero cost that are sought at most (cost: time and memory).
MAX_MODES = 1024
_DIAGNOSIS = "The diagnosis (--diagnosis; in Python groma.solver.observability.diagnosis.diagnose)"


def hold_cancelled_coordinates(system: ReducedSystem) -> tuple[BoolArray, FloatArray]:
    """Hold the coordinates of which the elimination of landmarks left rounding alone; blocks of S are changed.

    Returns
    -------
    tuple
        Which unknowns they are; and their moves (unknowns, k) by what makes the diagonal of H one, those of a block in
        columns of their own.
    """
    layout = system.layout
    found = np.zeros(layout.num_kept_unknowns, bool)
    moves = np.zeros((layout.num_kept_unknowns, max(kept.width for kept in layout.kept)))
    for c, kept in enumerate(layout.kept):
        direct, S, steps = system.diagonal(c), system.S[c, c][: kept.count], np.arange(kept.width)
        cancelled = (direct > 0.0) & (S[:, steps, steps] <= LANDMARK_TOLERANCE * direct)
        S[:, steps, steps] += np.where(cancelled, direct, 0.0)
        rows = np.flatnonzero(cancelled)
        moves[kept.start + rows, rows % kept.width] = 1.0 / np.sqrt(direct.reshape(-1)[rows])
        kept.blocks_of(found)[:] = cancelled
    return found, moves


def hold_unobservable_blocks(
    equations: NormalEquations, S: Blocks, size: FloatArray, known: BoolArray, G: FloatArray
) -> tuple[Blocks, BoolArray]:
    """Hold the directions in which planes, directions and other kept landmarks move no residual.

    Parameters
    ----------
    equations
        Linearised.
    S : dict
        Scaled system.
    size : (unknowns,) float
        What the unknowns were multiplied by.
    known : (unknowns,) bool
        Which are held already.
    G : (unknowns, k) float
        Free motions of the scene, which are held elsewhere.

    Returns
    -------
    tuple
        The system, and which unknowns are unobservable.
    """
    S, unobservable = dict(S), np.zeros(len(known), bool)
    for c, (kept, kind) in enumerate(zip(equations.layout.kept, equations.layout.kinds, strict=True)):
        if kind in ("pose", "intrinsics"):
            continue
        H = equations.H[c, c][: kept.count * kept.width**2].reshape(kept.count, kept.width, kept.width)
        H, own_size = scaled_blocks(H)
        H[:, np.arange(kept.width), np.arange(kept.width)] += kept.blocks_of(known)
        values, vectors = np.linalg.eigh(H)
        carried = np.any(kept.blocks_of(G) != 0.0, axis=(1, 2))
        null = (values < LANDMARK_TOLERANCE) & ~carried[:, None]
        if null.any():
            X = vectors * null[:, None, :] * (kept.blocks_of(size) / own_size)[:, :, None]
            X /= np.maximum(np.linalg.norm(X, axis=1, keepdims=True), 1e-300)
            blocks = S[c, c].copy()
            blocks[: kept.count] += X @ np.swapaxes(X, 1, 2)
            S[c, c] = blocks
            kept.blocks_of(unobservable)[:] = np.any(np.abs(X) > LOOSE, axis=2)
    return S, unobservable


def zero_modes(layout: Layout, fronts: Fronts, S: Blocks) -> Modes:
    """Return the smallest modes of a scaled system: all of zero cost and, if possible, at least one more."""
    count, most = MODES, min(MAX_MODES, layout.num_kept_unknowns)
    modes = smallest(layout, fronts, S, count)
    while modes.num_null == count < most:
        count = min(4 * count, most)
        modes = smallest(layout, fronts, S, count)
    return modes


def loses_the_cameras(layout: Layout, modes: Modes) -> bool:
    """Tell whether modes of zero cost move more of the poses than a few, or are more than were sought."""
    if modes.num_null == len(modes.values):
        return True
    loose = np.any(np.abs(modes.vectors[:, : modes.num_null]) > LOOSE, axis=1)
    poses = np.repeat([kind == "pose" for kind in layout.kinds], [c.count * c.width for c in layout.kept])
    return bool(poses.any() and loose[poses].mean() > MAX_LOOSE)


def deficiency(layout: Layout, modes: Modes, num_free: int) -> ProblemError:
    """Return the error with the number of unobservable directions and what they move.

    ``num_free`` of them are motions of the whole scene that nothing holds.
    """
    if not len(modes.values):
        return ProblemError(
            "The normal equations are spoilt by rounding: some residual changes far more than all others when its "
            f"variables move. {_DIAGNOSIS} may name them; leave them out, or adjust with a robust loss."
        )
    number = f"at least {modes.num_null}" if modes.num_null == len(modes.values) else str(max(modes.num_null, 1))
    if num_free:
        return ProblemError(
            f"The normal equations are rank deficient by {number}; {num_free} of them are motions of the whole scene. "
            "Hold variables constant, pass gauge='inner', or add priors."
        )
    null: BoolArray = np.asarray(np.abs(modes.vectors[:, : modes.num_null]) > LOOSE)
    moved, total = 0, 0
    for kept, kind in zip(layout.kept, layout.kinds, strict=True):
        if kind == "pose":
            moved, total = moved + int(kept.blocks_of(null).any(axis=(1, 2)).sum()), total + kept.count
    what = f"; {moved} of {total} poses are not determined" if moved else ""
    return ProblemError(
        f"The normal equations are rank deficient by {number}{what}. "
        f"{_DIAGNOSIS} names what is not determined; leave it out, or add observations or measurements of it."
    )
