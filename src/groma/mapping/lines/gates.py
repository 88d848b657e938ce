# SPDX-License-Identifier: BSD-3-Clause
"""When places, segments and lines belong together: numbers that are the same at every step of mapping lines."""

from __future__ import annotations

from dataclasses import dataclass

from groma.gates import LINE_MAPS, chi_square_gate, gate


@dataclass(frozen=True)
class AgreementGates:
    """When two measurements are of one line."""

    outlier_probability: float = gate(
        0.0027, "probability", "of noise alone making one line look like two", "convention: three standard deviations"
    )
    min_common: float = gate(0.6, "share", "of the images of a line, that another explains", LINE_MAPS)

    min_ratio: float = gate(2.0, "1", "images of a line that only runs near another, over its own", LINE_MAPS)
    depth: float = gate(0.01, "1", "relative difference of inverse depths of a point and a segment", LINE_MAPS)

    def max_squared(self, dof: int) -> float:
        """Largest squared Mahalanobis distance of two that agree."""
        return chi_square_gate(self.outlier_probability, dof)


AGREEMENT = AgreementGates()
