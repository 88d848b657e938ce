# SPDX-License-Identifier: BSD-3-Clause
"""The numbers of localisation."""

from __future__ import annotations

from dataclasses import dataclass

from groma.gates import gate


@dataclass(frozen=True)
class HypothesisGates:
    """Which poses are proposed from few matches."""

    slack: float = gate(2.0, "1", "of the limit, for poses from few matches", "derived from noise: they are noisier")
    min_trials: int = gate(100, "samples", "drawn at least", "chosen on castle, fountain, kitchen: as with 1,000")
    max_trials: int = gate(20_000, "samples", "drawn at most", "cost: half a second")
    min_matches: int = gate(4, "matches", "a pose is not looked for in fewer", "derived from P3P: three and one more")


@dataclass(frozen=True)
class RefinementGates:
    """How a pose is fitted to what agrees with it."""

    rounds: int = gate(5, "rounds", "of collecting what is near the pose, at most", "cost: of a fit each")
    wide_loss: float = gate(1.5, "sigma", "scale of the Cauchy loss of these", "chosen on tracked sequences")
    last_loss: float = gate(1.9, "sigma", "of the Geman-McClure loss of many matches", "chosen on stairs of 7-Scenes")
    cells: int = gate(8, "cells", "per longer side: errors within one may be alike", "derived from sizes of surfaces")
    square: float = gate(
        0.003, "1", "standard deviation of the logarithm of an unknown shape of pixels",
        "derived from calibrated cameras: 0 to 0.007",
    )  # fmt: skip
    stated_weight: float = gate(
        10.0, "observations", "that the stated noise counts for beside the noise that residuals show",
        "derived from chi-square: its estimate is then good to 40 % by itself",
    )  # fmt: skip


@dataclass(frozen=True)
class VerdictGates:
    """When a pose is believed."""

    cells: int = gate(32, "cells", "per longer side: each counts once", "derived from a descriptor's reach")
    search_share: float = gate(0.1, "share", "of the longer side, between lines alike", "chosen on the cabinet")
    right: float = gate(0.999, "probability", "that the pose is right, for it to be believed", "convention: 1 in 1000")
    loose: float = gate(0.1, "rad", "largest deviation of a turn, or of the centre by distance", "convention: a tenth")
    distinct: float = gate(5.0, "thresholds", "by which another pose moves all", "derived from noise: well beyond")
    beside: float = gate(0.125, "share", "of the longer side: cells as near are neighbours", "convention: an eighth")
    parts: int = gate(8, "parts", "per longer side: each shows what is expected there", "chosen on the filing cabinet")
    expected: float = gate(3.0, "points", "expected in a part that counts", "derived from Poisson: none once in twenty")
    whole: float = gate(0.99, "probability", "that more of it is there than is missing", "chosen on the filing cabinet")
    elsewhere: tuple[float, float] = gate(
        (0.5, 0.2), "share",
        "of how often all points are found, that telling ones are in another place: alone, and beside others",
        "chosen on five rendered facades: right and wrong places are told with most probability",
    )  # fmt: skip
    scatter: float = gate(
        0.17, "share", "standard deviation of this from photograph to photograph, of its mean",
        "chosen on five rendered facades: as above",
    )  # fmt: skip
    focal: float = gate(0.01, "share", "of the focal length: a step that tells another lens", "convention: a hundredth")
    shift: float = gate(
        0.05, "focal lengths", "of an estimated principal point from the one that was given, if it is to be told",
        "convention: lenses are centred to some hundredths",
    )  # fmt: skip
    bend: float = gate(
        0.15, "share", "of their distance, by which neighbours may be off differently",
        "derived from perspective: as between views 10 degrees apart",
    )  # fmt: skip


#: The numbers in use.
HYPOTHESES, REFINEMENT, VERDICT = HypothesisGates(), RefinementGates(), VerdictGates()
