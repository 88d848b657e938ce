# SPDX-License-Identifier: BSD-3-Clause
"""What counts as a plane: the options of :func:`groma.estimators.plane_search.find_planes`."""

from dataclasses import dataclass

from groma.gates import SEARCH, gate


@dataclass(frozen=True)
class PlaneOptions:
    """What counts as a plane."""

    #: A point lies on a plane when the chi-square test of its distance passes at this level (convention: level of a
    #: test).
    level: float = 0.95
    #: Least number of points; a segment counts as two.
    min_support: int = 10
    #: Largest standard deviation of the normal, radians (convention: two degrees): narrow faces, such as those of legs
    #: and boards, are known no better. Round bodies and walls have the same planes with half a degree to two.
    max_tilt: float = 0.035
    #: Least part of the features in the layer around a plane that lie on it.
    min_share: float = 0.2
    #: Expected number of planes found where there are none (convention: of tests by meaningfulness).
    max_false_alarms: float = 1e-4
    #: Random seed of the candidates.
    seed: int = 0


_SURVEYED = "chosen on Strecha's scenes and synthetic buildings"


@dataclass(frozen=True)
class PlaneSearchGates:
    """How planes are searched in points and segments: candidates, their growth, their layer, and the end."""

    thicker: float = gate(
        4.0, "1", "by which the noise of features grows where rough walls are searched",
        "derived from the layer: planes four times as rough as the noise stand out in it",
    )  # fmt: skip
    neighbours: int = gate(32, "features", "neighbours that make a candidate, and that improve it", _SURVEYED)
    rank: int = gate(8, "features", "the neighbour whose distance is the spacing", _SURVEYED)
    features_per_seed: int = gate(4, "features", "for each that is a seed, in large scenes", SEARCH)
    min_seeds: int = gate(1536, "seeds", "seeds in small scenes", SEARCH)
    repeated: int = gate(4, "seeds", "seeds at one feature", SEARCH)
    rounds: int = gate(3, "rounds", "rounds in which a candidate is improved", SEARCH)
    near_segments: int = gate(24, "segments", "nearest segments that a segment is paired with", SEARCH)
    pairs: int = gate(2, "pairs", "pairs of a segment that become candidates", SEARCH)
    crossing: float = gate(0.26, "1", "sine of the angle of planes that cross", "convention: 15 degrees")
    not_collinear: float = gate(25.0, "variances", "spread of two segments across the longest axis", _SURVEYED)
    max_followed: int = gate(8192, "features", "features that score a candidate", SEARCH)
    link: float = gate(3.0, "spacings", "links between features on a plane", _SURVEYED)
    wider: float = gate(4.0, "1", "factor of the squared gate while a candidate is inexact: twice as far", _SURVEYED)
    far: float = gate(50.0, "1", "factor of the squared gate beyond which features never join", SEARCH)
    grow_steps: int = gate(10, "rounds", "rounds of refinement on growing support", "cost: ends when nothing moves")
    converged: float = gate(0.1, "sigma", "growth ends when no feature moves by more", "cost: a tenth of the noise")
    band: float = gate(8.0, "sigma", "half thickness of the layer in which a plane must stand out", _SURVEYED)
    polish_steps: int = gate(3, "rounds", "rounds with the probability of membership as the weight", _SURVEYED)
    hopeless: float = gate(0.5, "share", "of the least share; a plane below is given up early", SEARCH)
    fit_rounds: int = gate(10, "rounds", "of a fit with the variances of the last normal", "cost: converges in fewer")
    extent: float = gate(0.9, "quantile", "of the distances from its middle: the radius of a plane", _SURVEYED)
    refined: float = gate(10.0, "planes", "planes that a refined candidate stands for", "derived from its rounds")
    patience: int = gate(100, "candidates", "failures in a row that end the search", SEARCH)
    candidates_per_failure: int = gate(64, "candidates", "candidates for one more failure", SEARCH)


#: The numbers in use.
PLANE_SEARCH = PlaneSearchGates()
