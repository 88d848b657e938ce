# SPDX-License-Identifier: BSD-3-Clause
"""Does the focal length that was given agree with what is seen? An estimate of it tells.

With a wrong one a pose nearer or farther fits about as well, by the distances of its landmarks; its stated deviation
then is that of another camera. What agrees with that pose was chosen by it, so that one step from there says little:
the focal length is fitted to all that is near, as a pose is, until that stays the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma.gates import gate
from groma.localization.pose.matches import Matches
from groma.localization.pose.refinement import Refined, refine


@dataclass(frozen=True)
class FocalGates:
    """What a focal length is estimated from."""

    matches: int = gate(400, "matches", "at most, every so many-th", "cost: of a fit")


GATES = FocalGates()


def focal_step(refined: Refined, matches: Matches, max_error: tuple[float, float]) -> tuple[float, float]:
    """Return the share by which the focal length should grow, and its standard deviation; the latter is infinite where
    that is not determined.

    Parameters
    ----------
    refined, matches
        A pose with the focal length that was given, and what was looked for near it.
    max_error
        Of :func:`groma.localization.pose.refinement.refine`.
    """
    some = _evenly(matches, GATES.matches)
    found = refine(refined.camera, some, refined.pose, max_error, "focal", gathered=True)
    given, estimated = (one.camera.kind.focal_length(one.camera.params) for one in (refined, found))
    variance = found.joint_covariance(some)[6, 6]
    return float(np.log(estimated / given)), float(np.sqrt(variance))


def _evenly(matches: Matches, count: int) -> Matches:
    """Every so many-th match, so that so many are left."""
    step = -(-(matches.num_points + matches.num_lines) // count)
    return matches.take(np.arange(0, matches.num_points, step), np.arange(0, matches.num_lines, step))
