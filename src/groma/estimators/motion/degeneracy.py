# SPDX-License-Identifier: BSD-3-Clause
"""What a configuration of lines and points leaves open, in words."""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.estimators.motion.groups import Kind
from groma.estimators.motion.matches import LandmarkMatches

#: Offsets within this many standard deviations count as zero (derived from normal noise: one in 16 000 is larger).
_SIGMAS = 4.0


def why_open(matches: LandmarkMatches, kind: Kind) -> str:
    """Say why matches do not determine a motion, and what to do."""
    few = "too few lines and points in different places and directions agree. Add some that lie apart from them."
    return what_is_common(matches, kind) or few


def what_is_common(matches: LandmarkMatches, kind: Kind) -> str | None:
    """Say what all matches have in common that leaves a motion open; None where that is nothing."""
    ends, points = matches.lines_in_b, matches.points_in_b
    if len(ends):
        step = ends[:, 1] - ends[:, 0]
        length = np.linalg.norm(step, axis=1)
        unit = step / length[:, None]
        sigma = matches.line_sigma[:, 1]
        axis = np.linalg.eigh(np.einsum("ni,nj->ij", unit, unit))[1][:, 2]
        apart = np.linalg.norm(unit - (unit @ axis)[:, None] * axis, axis=1) * length
        if not len(points) and (apart < _SIGMAS * 2 * sigma).all():
            return (
                "all lines are parallel, and can be moved along themselves. Add lines in other directions, or points."
            )
        center = _common_point(ends[:, 0], unit, points)
        off = np.linalg.norm(np.cross(ends[:, 0] - center, unit), axis=1)
        beyond = np.abs(np.einsum("ni,ni->n", center - ends.mean(axis=1), unit)) / length
        if kind != "rigid" and not len(points) and (off < _SIGMAS * sigma * (1.0 + 2.0 * beyond)).all():
            return "all lines meet in one point, around which they can be scaled. Add lines beside it, or points."
    places = np.concatenate([ends.reshape(-1, 3), points])
    sigmas = np.concatenate([np.repeat(matches.line_sigma[:, 1], 2), matches.point_sigma[:, 1]])
    centred = places - places.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2] if len(places) > 2 else np.eye(3)
    if kind == "projective" and (np.abs(centred @ axes[2]) < _SIGMAS * sigmas).all():
        return "all lines and points lie in one plane, which says nothing of what lies beside it. Add some beside it."
    if (np.linalg.norm(centred @ axes[1:].T, axis=1) < _SIGMAS * sigmas).all():
        return "all lines and points lie on one line, around which they can turn. Add some beside it."
    return None


def _common_point(place: FloatArray, unit: FloatArray, points: FloatArray) -> FloatArray:
    """The point (3,) nearest to all lines."""
    across = np.eye(3) - unit[:, :, None] * unit[:, None, :]
    return np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, place), rcond=None)[0]
