# SPDX-License-Identifier: BSD-3-Clause
"""What counts as a plane: the options of :func:`groma.estimators.plane_search.find_planes`."""

from dataclasses import dataclass


@dataclass(frozen=True)
class PlaneOptions:
    """What counts as a plane."""

    #: A point lies on a plane when the chi-square test of its distance passes at this level.
    level: float = 0.95
    #: Least number of points; a segment counts as two.
    min_support: int = 10
    #: Largest standard deviation of the normal, radians. Half a degree.
    max_tilt: float = 0.0087
    #: Least part of the features in the layer around a plane that lie on it.
    min_share: float = 0.2
    #: Expected number of planes found where there are none.
    max_false_alarms: float = 1e-4
    #: Where the random choice of candidates begins.
    seed: int = 0


__all__ = ["PlaneOptions"]
