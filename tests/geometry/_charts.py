# SPDX-License-Identifier: BSD-3-Clause
"""What the tests of charts share."""

import numpy as np

STEP = 1e-4


def by_name(chart):
    """Name a chart in the identifier of a test."""
    return chart.name


def differences(chart, state, step=STEP):
    """Fourth-order central differences of the ambient numbers through retract, (N, ambient_size, dof)."""
    out = np.empty((len(state), chart.ambient_size, chart.dof))
    for k in range(chart.dof):

        def at(h, k=k):
            delta = np.zeros((len(state), chart.dof))
            delta[:, k] = h
            return chart.ambient(chart.retract(state, delta))

        out[:, :, k] = (8 * (at(step) - at(-step)) - (at(2 * step) - at(-2 * step))) / (12 * step)
    return out
