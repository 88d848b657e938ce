# SPDX-License-Identifier: BSD-3-Clause
"""What an adjustment says of the measurements of other instruments: one record for each, and sums of kinds.

:mod:`groma.adjustment.survey.reliability` computes them and has the formulas.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from scipy.special import ndtri

from groma.gates import gate


@dataclass(frozen=True)
class ReliabilityGates:
    """The test for gross errors."""

    level: float = gate(1e-3, "probability", "of calling a good measurement wrong", "convention: Baarda")
    power: float = gate(0.8, "probability", "of finding an error of the size told", "convention: Baarda")
    outliers: float = gate(
        0.25, "share", "of a kind that may be wrong; of more, the kind is worse than stated", "cost: a wrong sentence"
    )


GATES = ReliabilityGates()


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
    """What an adjustment says of the measurements of other instruments than the cameras."""

    measurements: tuple[Measurement, ...]
    check_points: tuple[CheckPoint, ...]
    #: Standard deviations that the residuals show over those stated, by kind, without suspects if these are few; None
    #: where nothing is redundant.
    components: dict[str, float | None] = field(default_factory=dict)
    #: Sums of redundancy numbers by kind.
    redundancy: dict[str, float] = field(default_factory=dict)
    #: Level and power of the test, and the limit of normalised residuals.
    level: float = GATES.level
    power: float = GATES.power

    @property
    def limit(self) -> float:
        """Normalised residuals beyond are called wrong."""
        return float(-ndtri(self.level / 2.0))

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
        }


def noncentrality(level: float = GATES.level, power: float = GATES.power) -> float:
    """Return by how many standard deviations a mean must be off for a two-sided test to find it with a power."""
    return float(ndtri(power) - ndtri(level / 2.0))


__all__ = ["GATES", "CheckPoint", "Measurement", "Reliability", "ReliabilityGates", "noncentrality"]
