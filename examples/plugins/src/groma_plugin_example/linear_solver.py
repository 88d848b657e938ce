# SPDX-License-Identifier: BSD-3-Clause
"""A linear solver: the reduced system by its eigenvalues, slow and easy to look into."""

import math

import numpy as np

from groma.solver.linear.blocks import split
from groma.solver.linear.contract import PIVOT_TOLERANCE, register_linear_solver
from groma.solver.linear.dense import Dense


@register_linear_solver("eigenvalues")
class Eigenvalues:
    """Keeps the eigenvalues of the last matrix, ascending, in ``values``."""

    name = "eigenvalues"
    num_iterations = 0
    residual = None

    def __init__(self, layout):
        self.layout, self.matrix, self.values = layout, Dense(layout), np.zeros(0)

    def expected_seconds(self):
        return math.inf  # never the choice of `auto`

    def follow(self, states):
        pass

    def solve(self, blocks, rhs):
        S = np.zeros((self.layout.num_kept_unknowns,) * 2)
        self.matrix.fill(blocks, S)  # the upper triangle
        self.values, vectors = np.linalg.eigh(S, UPLO="U")
        if self.values[0] <= PIVOT_TOLERANCE * self.values[-1]:
            return None
        return split(self.layout, vectors @ ((vectors.T @ np.concatenate(rhs)) / self.values))
