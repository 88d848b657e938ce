# SPDX-License-Identifier: BSD-3-Clause
"""Records of the measurements of other instruments after an adjustment: one for each, and sums by kind.

:mod:`groma.adjustment.survey.reliability` computes them and has the formulas.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import scipy  # its parts are imported when something of them is first used

from groma.gates import NORMAL, SIGMA_OF_MEDIAN, gate


@dataclass(frozen=True)
class ReliabilityGates:
    """The test for gross errors."""

    power: float = gate(0.8, "probability", "of finding an error of the size told", "convention: Baarda")
    few: int = gate(5, "coordinates", "of a kind, whose scatter tells its noise", "cost: whether a kind is doubted")
    checked: float = gate(0.01, "share", "below which nothing checks a measurement", "convention: of geodesy")
    at_once: float = gate(0.5, "share", "of the largest residual, for what is rejected with it", "cost: rounds")
    max_rounds: int = gate(10, "rounds", "of rejecting and accepting again", "cost: most need two")


GATES = ReliabilityGates()


#: Tables of the scene by kind of measurement.
TABLES = {
    "camera position": "camera_positions", "camera pose": "camera_poses", "control point": "control_points",
    "mark": "marks", "distance": "distances", "known plane": "known_planes", "known direction": "known_directions",
}  # fmt: skip


@dataclass(frozen=True)
class Measurement:
    """One measured coordinate after the adjustment; lengths in scene units, of marks in pixels, angles in degrees."""

    #: ``camera position``, ``camera pose``, ``control point``, ``mark``, ``distance``, ``known plane`` or
    #: ``known direction``.
    kind: str
    #: Image, point, point and image, landmark, or both ends.
    name: str
    #: ``x``, ``y``, ``z``, ``u``, ``v``, ``turn x`` and so on, ``a`` and ``b`` (across a direction), or nothing.
    coordinate: str
    #: Standard deviation as stated.
    sigma: float
    #: Measured less computed.
    residual: float
    #: How far the others check it, from 0 to 1.
    redundancy: float
    #: Normalised residual; None where nothing checks the measurement.
    normalized: float | None
    #: Smallest error that the test finds with the stated power, and how far a smaller one moves the result, in
    #: standard deviations of that; None where nothing checks the measurement.
    detectable: float | None
    external: float | None
    #: Whether the test calls it wrong.
    is_suspect: bool
    #: Weight that the robust loss left it.
    weight: float = 1.0
    #: Its row in the table of the scene, and whether it was rejected as a gross error: it then took no part.
    row: int = 0
    is_rejected: bool = False

    @property
    def table_row(self) -> tuple[str, int]:
        """Table of the scene and row in it."""
        return TABLES[self.kind], self.row


@dataclass(frozen=True)
class CheckPoint:
    """A point whose coordinates took no part."""

    name: str
    #: (3,) computed less measured, and standard deviations of that: of the scene and of the measurement together.
    difference: tuple[float, float, float]
    sigma: tuple[float, float, float]
    #: Squared difference in units of its covariance; 3 on average.
    normalized_square: float


@dataclass(frozen=True)
class Reliability:
    """Reliability of external measurements in an adjustment: residuals, redundancy numbers and tests."""

    measurements: tuple[Measurement, ...]
    check_points: tuple[CheckPoint, ...]
    #: Standard deviations that the residuals show over those stated, by kind, without gross errors; None where
    #: nothing is redundant.
    components: dict[str, float | None] = field(default_factory=dict)
    #: Sums of redundancy numbers by kind.
    redundancy: dict[str, float] = field(default_factory=dict)
    #: Level and power of the test, and the limit of normalised residuals.
    level: float = NORMAL.gross
    power: float = GATES.power

    @property
    def limit(self) -> float:
        """Normalised residuals beyond are called wrong."""
        return float(-scipy.special.ndtri(self.level / 2.0))

    @property
    def suspects(self) -> tuple[Measurement, ...]:
        """Measurements that the test calls wrong, the worst first."""
        found = [one for one in self.measurements if one.is_suspect]
        return tuple(sorted(found, key=lambda one: -abs(one.normalized or 0.0)))

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return {
            "level": self.level,
            "power": self.power,
            "limit": self.limit,
            "variance_components": dict(self.components),
            "redundancy": dict(self.redundancy),
            "measurements": [asdict(one) for one in self.measurements],
            "check_points": [asdict(one) for one in self.check_points],
            "suspects": [f"{one.kind} {one.name} {one.coordinate}".rstrip() for one in self.suspects],
            "rejected": list(dict.fromkeys(f"{one.kind} {one.name}" for one in self.suspects if one.is_rejected)),
        }


def rejection_limit(measurements: Sequence[Measurement]) -> float:
    """Return the normalised residual that any of ``count`` good measurements exceeds with a small probability."""
    tests = sum(one.normalized is not None for one in measurements)
    return float(-scipy.special.ndtri(NORMAL.false_alarm / (2.0 * max(tests, 1))))


def gross_errors(measurements: Sequence[Measurement]) -> dict[tuple[str, int], float]:
    """Return by table and row the measurements beyond what the noise of their kind explains, all tests taken together.

    That noise is the stated one, or a larger one that the kind itself shows by the median of its normalised residuals:
    where all are worse than stated, none is a gross error for that. The values are the largest normalised residuals.
    """
    tests = [(one.kind, one.table_row, abs(one.normalized)) for one in measurements if one.normalized is not None]
    limit = rejection_limit(measurements)
    found: dict[tuple[str, int], float] = {}
    for kind in dict.fromkeys(kind for kind, _, _ in tests):
        sizes = [(place, size) for of, place, size in tests if of == kind]
        shown = SIGMA_OF_MEDIAN * float(np.median([size for _, size in sizes])) if len(sizes) >= GATES.few else 1.0
        for place, size in sizes:
            if size > limit * max(1.0, shown):
                found[place] = max(size, found.get(place, 0.0))
    return found


def noncentrality(level: float = NORMAL.gross, power: float = GATES.power) -> float:
    """Return by how many standard deviations a mean must be off for a two-sided test to find it with a power."""
    return float(scipy.special.ndtri(power) - scipy.special.ndtri(level / 2.0))
