# SPDX-License-Identifier: BSD-3-Clause
"""Cameras that stand out: large residuals, few observations, or little certainty."""

from __future__ import annotations

import numpy as np

from groma._counted import counted
from groma._typing import BoolArray, FloatArray
from groma.solver.linear.visible_motion import weakest
from groma.solver.observability.findings import Finding, few
from groma.solver.observability.gates import DIAGNOSIS
from groma.solver.observability.inspection import Inspection


def camera_findings(inspection: Inspection, reported: set[tuple[str, int]]) -> list[Finding]:
    """Find the cameras that stand out; ``reported`` are known to be unobservable and are not mentioned again."""
    findings: list[Finding] = []
    for name, (sums, rows) in inspection.residuals_of_cameras.items():
        seen = rows > 0
        if seen.sum() < 2:
            continue
        rms = np.sqrt(sums / np.maximum(rows, 1))
        usual, typical = float(np.median(rms[seen])), float(np.median(rows[seen]))
        known = np.array([(name, i) in reported for i in range(len(rows))])
        little = seen & (rows < np.maximum(DIAGNOSIS.little * typical, DIAGNOSIS.min_numbers))
        large = max(DIAGNOSIS.large_residual * usual, DIAGNOSIS.min_residual)
        found = [
            _suspicious(
                inspection, "camera_residuals", name, seen & (rms > large),
                rms / max(usual, 1e-300), "residuals {:,.0f} times the usual",
                "Wrong matches, or a wrong pose or calibration.",
            ),
            _suspicious(
                inspection, "camera_few_observations", name, little & ~known, rows,
                f"{{:,.0f}} measured numbers; usual are {typical:,.0f}", "Add matches.",
            ),
            _faint(inspection, name, known | little),
        ]  # fmt: skip
        findings += [finding for finding in found if finding is not None]
    return findings


def _faint(inspection: Inspection, name: str, known: BoolArray) -> Finding | None:
    if not any(member.group == name for kept in inspection.layout.kept for member in kept.members):
        return None
    information, held, _ = inspection.information_of(name)
    free = ~held.any(axis=1)
    if not free.any():
        return None
    sigma = weakest(information, inspection.motion_of(name))[0][:, 0]
    usual = float(np.median(sigma[free]))
    return _suspicious(
        inspection, "camera_faint", name, ~known & free & (sigma > DIAGNOSIS.faint * usual), sigma / usual,
        "{:,.0f} times less certain than the rest", "What it sees is little, far away or all on one side.",
    )  # fmt: skip


def _suspicious(
    inspection: Inspection, kind: str, name: str, which: BoolArray, amount: FloatArray, words: str, remedy: str
) -> Finding | None:
    bad = np.flatnonzero(which)
    if len(bad) == 0:
        return None
    bad = bad[np.argsort(-np.abs(amount[bad] - np.median(amount)), kind="stable")]
    what = few([f"{inspection.names(name, int(i))} ({words.format(amount[i])})" for i in bad], 3)
    text = f"{counted(len(bad), 'cameras')} stand{'s' if len(bad) == 1 else ''} out: {what}. {remedy}"
    return Finding(kind, "warning", text, name, tuple(map(int, bad)), {"worst": float(amount[bad[0]])})
