# SPDX-License-Identifier: BSD-3-Clause
"""Thresholds of the messages of the diagnosis. No estimate depends on them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from groma.gates import gate

_WORDS = "convention: words of a report"
_CLASSES = "chosen on the degenerate scenes of the tests"


@dataclass(frozen=True)
class DiagnosisGates:
    """What counts as not determined, as weak, and as standing out."""

    undetermined: float = gate(1.0, "viewing distances or rad", "of what nothing determines", "derived from linearity")
    weak: float = gate(0.2, "viewing distances or rad", "standard deviation of one that is weak", _CLASSES)
    certain: float = gate(1e-5, "share", "of its usual cost that holds a motion", "derived from rounding")
    sample: int = gate(4096, "points", "for the centre and extent of the scene", "cost: time of a diagnosis")
    large_residual: float = gate(3.0, "ratio", "residuals of a camera that stands out, to the usual", _WORDS)
    min_residual: float = gate(1.5, "sigma", "and at least so large", _WORDS)
    little: float = gate(0.1, "share", "of the usual or largest: observations, motions, extents", _WORDS)
    min_numbers: int = gate(12, "numbers", "measured by a camera that has few", "derived from 6 unknowns, twice")
    faint: float = gate(10.0, "ratio", "uncertainty of a camera that stands out, to the usual", _WORDS)
    parallax: float = gate(math.radians(3.0), "rad", "angle of rays that determine a point", _CLASSES)
    small_parallax: float = gate(math.radians(0.3), "rad", "the same if its residuals say so", _CLASSES)
    along: float = gate(math.radians(5.0), "rad", "a line runs along a motion; planes through it are one", _CLASSES)
    end_on: float = gate(math.radians(0.5), "rad", "a ray sees a line end-on", _CLASSES)
    flat: float = gate(1e-3, "share", "of an extent: points on a plane, cameras in one place", _CLASSES)
    most: float = gate(0.9, "share", "of all landmarks: no single one is named", _WORDS)
    visible: float = gate(0.02, "share", "a smaller part of a unit motion is not mentioned", _WORDS)
    axis: float = gate(0.9995, "cosine", "a direction is called an axis of the world", _WORDS)
    takes_part: float = gate(0.05, "share", "motion of a variable in a mode, of the largest", _CLASSES)
    whole: float = gate(0.3, "share", "of the cameras in a mode: it is one of the whole", _WORDS)
    largest_motion: float = gate(100.0, "viewing distances", "motions are cut here", "derived from undetermined ones")
    one_by_one: int = gate(4, "variables", "described one by one; of more the names are listed", _WORDS)
    edge_on: float = gate(0.03, "share", "a camera so near to a plane sees it edge-on; nearly one place", _CLASSES)
    open_share: float = gate(0.01, "share", "singular value of a free direction, of the first", "derived from rounding")
    listed: int = gate(20, "indices", "indices listed in a report for machines", _WORDS)
    examples: int = gate(5, "names", "names in a sentence", _WORDS)


#: The numbers in use.
DIAGNOSIS = DiagnosisGates()
