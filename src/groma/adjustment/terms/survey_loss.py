# SPDX-License-Identifier: BSD-3-Clause
"""The loss of measurements from other instruments than the cameras, and the form of their noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray
from groma.factors.losses import Huber
from groma.gates import chi_square_gate, gate


@dataclass(frozen=True)
class SurveyGates:
    """Which measurements count as good as they are stated to be."""

    doubted: float = gate(
        1e-3, "probability", "of a measurement without an error whose influence is limited", "convention: Baarda"
    )


GATES = SurveyGates()


def survey_loss(coordinates: int) -> Huber:
    """Return the loss of measurements with a number of coordinates.

    Least squares up to where one in a thousand ends, linear beyond: good measurements count in full, and a wrong one
    pulls no more than a bad one. It is convex, so that a standard deviation stated too small costs weight, not the map.
    """
    return Huber(math.sqrt(chi_square_gate(GATES.doubted, coordinates)))


def root_information(covariance: FloatArray) -> FloatArray:
    """Return square roots U (N, 3, 3) of the inverses of covariances, U^T U = C^-1."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), np.float64)
