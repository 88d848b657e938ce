# SPDX-License-Identifier: BSD-3-Clause
"""Does the focal length that was given agree with what is seen? One step of an estimate with it tells.

With a wrong one a pose nearer or farther fits about as well, by the distances of its landmarks; its stated deviation
then is that of another camera.
"""

from __future__ import annotations

import numpy as np

from groma.localization.pose.matches import Matches
from groma.localization.pose.refinement import Refined, last_scale, problem_of, with_landmarks
from groma.localization.pose.residuals import residuals


def focal_step(refined: Refined, matches: Matches) -> tuple[float, float]:
    """Return the share by which the focal length should grow for what agrees with a pose, and its standard deviation;
    the latter is infinite where that is not determined.
    """
    camera, kept = refined.camera, matches.take(refined.point_inliers, refined.line_inliers)
    lens = sorted(camera.kind.focal_indices)
    problem = with_landmarks(problem_of(camera, kept, refined.pose, True), kept)
    counts = (("points", kept.num_points), ("lines", kept.num_lines))
    found = [residuals(problem, kind, count, lens) for kind, count in counts if count]
    J, r = (np.concatenate([getattr(one, name) for one in found]) for name in ("by_pose", "value"))
    grown = J[..., 6:] @ camera.params[lens]
    J = np.concatenate([J[..., :6], grown[..., None]], axis=2)
    weight = (1.0 + (r**2).sum(axis=1) / (last_scale(len(r)) * refined.sigma0) ** 2) ** -2
    information = np.einsum("n,nki,nkj->ij", weight, J, J)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    if not values[0] > 1e-10:
        return 0.0, float("inf")
    inverse = (vectors / values) @ vectors.T * np.outer(scale, scale)
    step = -inverse[6] @ np.einsum("n,nki,nk->i", weight, J, r)
    return float(step), refined.sigma0 * float(np.sqrt(inverse[6, 6]))
