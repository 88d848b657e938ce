# SPDX-License-Identifier: BSD-3-Clause
"""What happens to the records of a factor group between the factors and the sums: noise, loss, chart, constants.

A record is ``[J_1 | J_2 | ... | r]`` for each residual row; see :mod:`groma.factors.contract`.
"""

from __future__ import annotations

import numpy as np

from groma._numba import exact_kernel, loop, unrolled_loop
from groma._simd import set_product
from groma.factors.losses import loss_derivatives, loss_value

# ---------------------------------------------------------------------------------------------------------- Kernels


@loop
def whiten(record, begin, information):
    """Multiply each record from the left by its square root information matrix."""
    n, m, columns = record.shape
    old = np.empty(m)
    for i in range(n):
        for c in range(columns):
            for a in range(m):
                old[a] = record[i, a, c]
            for a in range(m):
                total = 0.0
                for b in range(m):
                    total += information[begin + i, a, b] * old[b]
                record[i, a, c] = total


@exact_kernel
def _sum_and_root(cost, rho, weight):
    """Return cost + rho and the root of the weight, rounded alike for every loss that is inlined before."""
    return cost + rho, np.sqrt(weight)


@unrolled_loop
def weigh(record, begin, scale, step, loss_tag, parameters, norms):
    """Scale each record by 1/sigma and by the root of the loss' weight; return sum of rho, write the squared norms."""
    n, m, columns = record.shape
    cost = 0.0
    for i in range(n):
        s = scale[(begin + i) * step]
        norm = 0.0
        for a in range(m):
            norm += record[i, a, columns - 1] * record[i, a, columns - 1]
        norm *= s * s
        norms[i] = norm
        rho, weight, _ = loss_derivatives(loss_tag, parameters, norm)
        cost, root = _sum_and_root(cost, rho, weight)
        s *= root
        if s != 1.0:
            for a in range(m):
                for c in range(columns):
                    record[i, a, c] *= s
    return cost


@loop
def cost_scaled(residual, begin, scale, step, loss_tag, parameters, landmark, costs):
    """Return the sum of rho; half of each is added to the cost of its landmark, where there are such costs."""
    n, m = residual.shape
    cost = 0.0
    for i in range(n):
        s = scale[(begin + i) * step]
        norm = 0.0
        for a in range(m):
            norm += residual[i, a] * residual[i, a]
        value = loss_value(loss_tag, parameters, norm * s * s)
        if len(costs):
            costs[landmark[begin + i]] += 0.5 * value
        cost += value
    return cost


@loop
def cost_whitened(residual, begin, information, loss_tag, parameters, landmark, costs):
    """As :func:`cost_scaled`, of residuals with square root information matrices."""
    n, m = residual.shape
    cost = 0.0
    for i in range(n):
        norm = 0.0
        for a in range(m):
            total = 0.0
            for b in range(m):
                total += information[begin + i, a, b] * residual[i, b]
            norm += total * total
        value = loss_value(loss_tag, parameters, norm)
        if len(costs):
            costs[landmark[begin + i]] += 0.5 * value
        cost += value
    return cost


@loop
def chain_rule(record, begin, raw, column, index, basis, raw_width, dof_width, one):
    """Columns of the chart = columns in factor coordinates times the basis of the chart."""
    n, m, columns = record.shape
    size, dof = len(raw_width), len(dof_width)
    for i in range(n):
        b = np.int64(index[begin + i]) * (size * dof)
        for a in range(m):
            row = (i * m + a) * columns
            set_product(record, row + column, record, row + raw, 1, basis, b, dof, raw_width, one, dof_width)
