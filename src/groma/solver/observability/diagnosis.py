# SPDX-License-Identifier: BSD-3-Clause
r"""What the data determine, and what they do not, in words.

:func:`diagnose` linearises a problem once, where it is. It looks at

- the seven motions of the whole scene, and names those that nothing holds
  (:mod:`groma.solver.observability.inspection`);
- the normal matrix of each landmark: what its observations do not determine, and why
  (:mod:`groma.solver.linear.visible_motion`, :mod:`groma.solver.observability.landmarks`);
- the weakest modes of the reduced system, with the scene held: cameras, planes and calibrations that are not
  determined, and parts of the scene that do not hang together (:mod:`groma.solver.observability.system`,
  :mod:`groma.solver.observability.variables`);
- the residuals of each camera (:mod:`groma.solver.observability.cameras`).

A direction counts as *not determined* when its standard deviation exceeds the viewing distance (or one radian), and as
*weak* from a fifth of that, at the noise that the factors state. Nothing here changes the problem.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from groma._counted import counted
from groma._typing import BoolArray, FloatArray
from groma.problem.lay_out import lay_out
from groma.problem.linearization import NormalEquations, to_solver_order
from groma.problem.parallel import Workers
from groma.problem.problem import Problem
from groma.problem.tied import with_tied_apart
from groma.solver.linear.blas import one_blas_thread
from groma.solver.linear.elimination import eliminate as eliminate_landmarks
from groma.solver.linear.schur import ReducedSystem
from groma.solver.linear.visible_motion import motion, observers, weakest
from groma.solver.observability.cameras import camera_findings
from groma.solver.observability.findings import Finding
from groma.solver.observability.gates import DIAGNOSIS
from groma.solver.observability.inspection import Inspection
from groma.solver.observability.landmarks import landmark_findings
from groma.solver.observability.messages import Names, listing, scene_freedom
from groma.solver.observability.system import separate_parts, unobservable_modes, unseen_variables
from groma.solver.observability.variables import variable_findings


@dataclass(frozen=True)
class Diagnosis:
    """What the data determine, and what they do not."""

    #: Motions of the whole scene that nothing holds, in words.
    free_motions: tuple[str, ...]
    #: How many such motions there are, 0 to 7.
    num_free_motions: int
    #: Directions beyond these that are not determined, of cameras, planes and calibrations.
    num_unobservable_directions: int
    findings: tuple[Finding, ...]
    #: For each group of landmarks, the standard deviation of every one, cameras held, as a share of the viewing
    #: distance: in all directions together where it is small, in the weakest where it is not; else infinite.
    weakness: dict[str, FloatArray]
    seconds: float

    @property
    def sentences(self) -> list[str]:
        """The findings in plain language, the gravest first."""
        return [finding.sentence for finding in self.findings]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return {
            "free_motions": list(self.free_motions),
            "num_free_motions": self.num_free_motions,
            "num_unobservable_directions": self.num_unobservable_directions,
            "sentences": self.sentences,
            "findings": [finding.to_dict() for finding in self.findings],
            "observability": {
                name: {
                    "determined": int((values < DIAGNOSIS.weak).sum()),
                    "weak": int(((values >= DIAGNOSIS.weak) & (values < DIAGNOSIS.undetermined)).sum()),
                    "undetermined": int((values >= DIAGNOSIS.undetermined).sum()),
                }
                for name, values in self.weakness.items()
            },
            "seconds": self.seconds,
        }


def diagnose(
    problem: Problem, names: Names | None = None, eliminate: str | tuple[str, ...] = "auto", threads: int = 1
) -> Diagnosis:
    """Report what the data determine and what they do not.

    Parameters
    ----------
    problem : Problem
        At its solution, or at a start: the diagnosis is that of the geometry where it is.
    names : callable, optional
        Name of a variable in sentences, from its group and index; ``image 12.png`` instead of ``poses 11``.
    eliminate : str or tuple of str
        As for :func:`groma.solver.solve.solve`.
    threads : int
        Threads for the linearisation.

    Returns
    -------
    Diagnosis
        Findings as sentences and as data.
    """
    begin = time.perf_counter()
    parts = with_tied_apart(problem, eliminate)
    layout = lay_out(parts.problem, eliminate)
    workers = Workers(threads)
    try:
        states = to_solver_order(layout)
        equations = NormalEquations(layout, workers)
        system = ReducedSystem(equations)
        equations.linearize(states, equations.prepare(states))
        eliminate_landmarks(system)
        system.assemble(0.0)
        with one_blas_thread():
            return _diagnosis(Inspection(problem, parts, layout, equations, system, names or _plain_name), begin)
    finally:
        workers.close()


def _plain_name(group: str, index: int) -> str:
    return f"{group.removesuffix('s')} {index}"


def _diagnosis(inspection: Inspection, begin: float) -> Diagnosis:
    """Collect all findings."""
    findings: list[Finding] = []
    weakness: dict[str, FloatArray] = {}
    moves: dict[tuple[str, int], FloatArray] = {}
    words: list[str] = []
    free, num_unobservable, reported = 0, 0, set()
    for eliminated in inspection.layout.eliminated:
        if eliminated.group not in inspection.landmarks:
            _alone(inspection, eliminated.group, weakness, moves)
    for name in inspection.landmarks:
        findings += _landmarks(inspection, name, weakness)
    if inspection.layout.kept:
        free = inspection.free_motions[0].shape[1]
        words = scene_freedom(inspection.free_motions[0])
        findings += separate_parts(inspection)
        unseen, reported = unseen_variables(inspection)
        apart = any(finding.kind == "separate_parts" for finding in findings)
        whole, unobservable_moves, num_unobservable = unobservable_modes(inspection, apart)
        findings += unseen + whole
        moves |= unobservable_moves
    described = variable_findings(inspection, {key: move for key, move in moves.items() if key not in reported})
    findings += described
    reported |= {(finding.group, i) for finding in described for i in finding.indices}
    findings += camera_findings(inspection, reported)
    order = {"problem": 0, "warning": 1, "note": 2}
    findings.sort(key=lambda finding: order[finding.severity])
    if words:
        text = (
            f"The scene as a whole is free in {counted(free, 'ways')}: {listing(words)}. No residual "
            "changes; hold cameras or add priors where the frame matters."
        )
        findings.append(Finding("free_motions", "note", text, values={"count": float(free)}))
    if not any(finding.severity == "problem" for finding in findings):
        but = " apart from the frame" if words else ""
        findings.insert(0, Finding("determined", "note", f"Everything{but} is determined by the data."))
    return Diagnosis(tuple(words), free, num_unobservable, tuple(findings), weakness, time.perf_counter() - begin)


def _alone(
    inspection: Inspection, name: str, weakness: dict[str, FloatArray], moves: dict[tuple[str, int], FloatArray]
) -> None:
    """Look at a group that is no landmarks and solved on its own."""
    group, J = inspection.problem.variables[name], inspection.motion_of(name)
    information, held, _ = inspection.information_of(name)
    sigma, directions = weakest(_with_held(information, held), J)
    for i in np.flatnonzero(sigma[:, 0] > DIAGNOSIS.undetermined):
        moves[name, int(i)] = directions[i] * np.minimum(sigma[i], DIAGNOSIS.largest_motion)
    if group.manifold.kind not in ("pose", "plane"):
        weakness[name] = sigma[:, 0]


def _landmarks(inspection: Inspection, name: str, weakness: dict[str, FloatArray]) -> list[Finding]:
    """Judge points or lines by the information on each with the cameras held, and its inverse where there is one."""
    group = inspection.problem.variables[name]
    information, held, inverse = inspection.information_of(name)
    seen = observers(inspection.problem, name, inspection.centers)
    # the root of the summed variances bounds the largest; where that is small, nothing more needs to be known
    if group.manifold.basis(group.state) is None:
        variance = np.einsum("nii->n", inverse) / seen.distance**2
    else:
        J = motion(group.manifold, group.state, seen.middle, seen.distance)
        variance = np.einsum("nij,nij->n", J @ inverse, J)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    rank = np.einsum("nij,nji->n", information, inverse)  # less where the elimination dropped a direction
    unsure = ~(sigma < DIAGNOSIS.weak) | (rank < information.shape[1] - 0.5) | held.any(axis=1)
    num_unobservable = np.zeros(len(group), np.int64)
    if unsure.any():
        J = motion(group.manifold, group.state[unsure], seen.middle[unsure], seen.distance[unsure])
        all_sigma, _ = weakest(_with_held(information[unsure], held[unsure]), J)
        sigma[unsure], num_unobservable[unsure] = all_sigma[:, 0], (all_sigma > DIAGNOSIS.undetermined).sum(axis=1)
    weakness[name] = sigma
    return landmark_findings(inspection, name, seen, sigma, num_unobservable)


def _with_held(information: FloatArray, held: BoolArray) -> FloatArray:
    """Return information in which held coordinates are certain."""
    if not held.any():
        return information
    size = np.einsum("nii->ni", information).max(axis=1, initial=0.0)
    result, steps = information.copy(), np.arange(information.shape[1])
    result[:, steps, steps] += np.where(held, 1e6 * np.maximum(size, 1.0)[:, None], 0.0)
    return result


__all__ = ["Diagnosis", "Finding", "diagnose"]
