# SPDX-License-Identifier: BSD-3-Clause
"""A fixed piece of numerical work whose CPU time is the unit in which times are compared between machines."""

from __future__ import annotations

import numpy as np
from _common import Clock, report


def main() -> None:
    rng = np.random.default_rng(0)
    blocks = rng.normal(size=(20_000, 9, 9))
    blocks = blocks @ blocks.transpose(0, 2, 1) + 9 * np.eye(9)
    values = rng.normal(size=1_000_000)
    matrix = rng.normal(size=(600, 600))
    clock = Clock()
    for _ in range(6):
        np.linalg.cholesky(blocks)
        np.sqrt(values * values + 1.0).sum()
        matrix @ matrix
    total = 0
    for k in range(400_000):
        total += k & 7
    report(**clock.read())


if __name__ == "__main__":
    main()
