# SPDX-License-Identifier: BSD-3-Clause
"""Every derivative, checked on this machine: against differences and, where given, against reference values."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from groma.cameras import models
from groma.cameras.check import derivative_errors
from groma.errors import InputError
from groma.factors.checks.check import compare_jacobians
from groma.factors.contract import registered


@dataclass(frozen=True)
class SelfCheckRow:
    """One comparison."""

    #: Registered name of the factor, of the reference file, or ``camera`` and the name of a camera model.
    factor: str
    #: Jacobian block, with the chart in brackets where there are several.
    block: str
    #: ``differences`` or ``golden``.
    against: str
    #: Factors, or points of a camera, compared.
    cases: int
    #: Largest deviation divided by the allowed one.
    worst: float
    #: Whether it is allowed.
    passed: bool


@dataclass(frozen=True)
class SelfCheckReport:
    """All comparisons of a self-check."""

    #: One row for each factor, block and chart.
    rows: tuple[SelfCheckRow, ...]

    @property
    def passed(self) -> bool:
        """Whether there is a row and every row passed."""
        return bool(self.rows) and all(row.passed for row in self.rows)

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain values, for JSON; a deviation that is not a number becomes None."""
        rows = [dataclasses.asdict(row) for row in self.rows]
        for row in rows:
            row["worst"] = row["worst"] if np.isfinite(row["worst"]) else None
        return {"passed": self.passed, "rows": rows}


def selfcheck(golden: Path | None = None, seed: int = 0) -> SelfCheckReport:
    """Compare the Jacobians of every registered factor and of COLMAP's camera models with differences.

    Those of factors also with reference values, if given.

    Parameters
    ----------
    golden : Path, optional
        Folder of reference values (``point.json``, ``line_endpoint.json``, ``line_normal.json``,
        ``plane_quaternion.json``).
    seed : int
        Seed of the random instances.

    Raises
    ------
    InputError
        If `golden` is not a folder.
    """
    rows = []
    for name, cls in registered().items():
        for check in compare_jacobians(cls.example(np.random.default_rng(seed))):
            block = f"{check.block} ({check.chart})"
            ratio = check.deviation / check.tolerance
            rows.append(SelfCheckRow(name, block, "differences", check.cases, ratio, check.passed))
    for model in models():
        if model.colmap_name is not None:
            for block, ratio in derivative_errors(model, np.random.default_rng(seed)).items():
                rows.append(SelfCheckRow(f"camera {model.name}", block, "differences", 50, ratio, ratio <= 1.0))
    if golden is not None:
        if not Path(golden).is_dir():
            raise InputError(
                f"The folder of reference values was expected at {golden}, but there is none. Check --golden."
            )
        from groma.factors.checks.golden import check_golden

        for row in check_golden(Path(golden)):
            rows.append(SelfCheckRow(row.factor, row.block, "golden", row.cases, row.worst, row.passed))
    return SelfCheckReport(tuple(rows))
