# SPDX-License-Identifier: BSD-3-Clause
"""The loss of measurements from other instruments than the cameras, and the form of their noise."""

from __future__ import annotations

import math

import numpy as np

from groma._typing import FloatArray
from groma.factors.losses import Huber
from groma.gates import NORMAL, chi_square_gate


def survey_loss(coordinates: int) -> Huber:
    """Return the loss of measurements with a number of coordinates.

    Least squares up to where one in a thousand ends, linear beyond: good measurements count in full, and a wrong one
    pulls no more than a bad one. It is convex, so that a standard deviation stated too small costs weight, not the map.
    """
    return Huber(math.sqrt(chi_square_gate(NORMAL.gross, coordinates)))


def root_information(covariance: FloatArray) -> FloatArray:
    """Return square roots U (N, 3, 3) of the inverses of covariances, U^T U = C^-1."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), np.float64)
