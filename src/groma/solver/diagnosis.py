# SPDX-License-Identifier: BSD-3-Clause
r"""What the data determine, and what they do not, in words.

:func:`diagnose` linearises a problem once, where it is. It looks at

- the seven motions of the whole scene, and names those that nothing holds;
- the normal matrix of each landmark: what its observations leave open, and why (:mod:`groma.solver._observability`);
- the weakest modes of the reduced system, with the scene held: cameras, planes and calibrations that are not
  determined, and parts of the scene that do not hang together;
- the residuals of each camera.

A direction counts as *not determined* when its standard deviation exceeds the viewing distance (or one radian), and as
*weak* from a fifth of that, at the noise that the factors state. Nothing here changes the problem.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from groma._typing import BoolArray, FloatArray
from groma.problem._parallel import Workers
from groma.problem.lay_out import lay_out
from groma.problem.layout import Layout
from groma.problem.linearization import NormalEquations, to_solver_order
from groma.problem.problem import Problem
from groma.solver._blas import one_blas_thread
from groma.solver._datum import FreeMotions, constrained, free_motions, held_coordinates
from groma.solver._findings import Finding, few, first_upper
from groma.solver._fronts import Fronts
from groma.solver._landmark_findings import landmark_findings
from groma.solver._modes import Modes, scaled, smallest
from groma.solver._observability import SEEN, camera_centers, motion, observers, weakest
from groma.solver._words import Names, camera_freedom, listing, plane_freedom, scene_freedom
from groma.solver.linear import Blocks
from groma.solver.schur import ReducedSystem

#: Standard deviation, in viewing distances or radians, from which a direction is not determined, or is weak.
UNDETERMINED, WEAK = 1.0, 0.2
#: A variable takes part in a mode if it moves by this share of the one that moves most.
SHARE = 0.05
#: A mode of more cameras than this share of all is one of the whole.
MANY = 0.3
#: A camera is suspicious if its residuals are this many times the usual, its observations this share of the usual, or
#: its uncertainty this many times the usual.
LARGE, FEW, FAINT = 3.0, 0.1, 10.0


@dataclass(frozen=True)
class Diagnosis:
    """What the data determine, and what they do not."""

    #: Motions of the whole scene that nothing holds, in words.
    free_motions: tuple[str, ...]
    #: How many such motions there are, 0 to 7.
    num_free_motions: int
    #: Directions beyond these that are not determined, of cameras, planes and calibrations.
    num_open_directions: int
    findings: tuple[Finding, ...]
    #: For each group of landmarks, the standard deviation of every one, cameras held, as a share of the viewing
    #: distance: in all directions together where it is small, in the weakest where it is not; infinite where open.
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
            "num_open_directions": self.num_open_directions,
            "sentences": self.sentences,
            "findings": [finding.to_dict() for finding in self.findings],
            "observability": {
                name: {
                    "determined": int((values < WEAK).sum()),
                    "weak": int(((values >= WEAK) & (values < UNDETERMINED)).sum()),
                    "undetermined": int((values >= UNDETERMINED).sum()),
                }
                for name, values in self.weakness.items()
            },
            "seconds": self.seconds,
        }


def diagnose(
    problem: Problem, names: Names | None = None, eliminate: str | tuple[str, ...] = "auto", threads: int = 1
) -> Diagnosis:
    """Say what the data determine and what they do not.

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
    layout = lay_out(problem, eliminate)
    workers = Workers(threads)
    try:
        states = to_solver_order(layout)
        equations = NormalEquations(layout, workers)
        system = ReducedSystem(equations)
        equations.linearize(states, equations.prepare(states))
        system.eliminate(0.0)
        system.assemble(0.0)
        with one_blas_thread():
            return _Examination(problem, layout, equations, system, names or _plain_name).diagnosis(begin)
    finally:
        workers.close()


def _plain_name(group: str, index: int) -> str:
    return f"{group.removesuffix('s')} {index}"


class _Examination:
    """One look at one linearisation."""

    def __init__(
        self, problem: Problem, layout: Layout, equations: NormalEquations, system: ReducedSystem, names: Names
    ) -> None:
        self.problem, self.layout, self.equations, self.system, self.names = problem, layout, equations, system, names
        self.centers = camera_centers(problem)
        self.motions: FreeMotions = free_motions(layout, equations, system)
        self.held, self.held_landmarks = held_coordinates(layout)
        self.findings: list[Finding] = []
        self.weakness: dict[str, FloatArray] = {}
        self.open_directions = 0
        self.open_cameras: set[tuple[str, int]] = set()

    def diagnosis(self, begin: float) -> Diagnosis:
        """Collect all findings."""
        words = scene_freedom(self.motions.combinations) if self.layout.kept else []
        for e in range(len(self.layout.eliminated)):
            self._eliminated(e)
        if self.layout.kept:
            self._parts()
            self._modes()
        self._cameras()
        order = {"problem": 0, "warning": 1, "note": 2}
        found = sorted(self.findings, key=lambda finding: order[finding.severity])
        if words:
            number = self.motions.count
            found.append(
                Finding(
                    "free_motions", "note",
                    f"The scene as a whole is free in {number} way{'s' if number > 1 else ''}: {listing(words)}. "
                    "This changes no residual; hold cameras or add priors where the frame matters.",
                    values={"count": float(number)},
                )
            )  # fmt: skip
        if not any(finding.severity == "problem" for finding in found):
            up_to = f", up to {listing(words)} of the whole" if words else ""
            found.insert(0, Finding("determined", "note", f"Everything is determined by the data{up_to}."))
        return Diagnosis(
            tuple(words), self.motions.count if words else 0, self.open_directions, tuple(found), self.weakness,
            time.perf_counter() - begin,
        )  # fmt: skip

    # Landmarks, and whatever else is solved on its own

    def _eliminated(self, e: int) -> None:
        eliminated = self.layout.eliminated[e]
        name, dof = eliminated.group, eliminated.dof
        group = self.problem.variables[name]
        V = np.empty((eliminated.count, dof, dof))
        V[eliminated.order] = self.equations.V[e].reshape(-1, dof, dof)
        held = np.empty((eliminated.count, dof), bool)
        held[eliminated.order] = self.held_landmarks[e].reshape(-1, dof)
        seen = observers(self.problem, name, self.centers) if group.manifold.kind in SEEN else None
        distance = np.full(len(group), self.motions.length) if seen is None else seen.distance
        J = motion(group.manifold, group.state, np.zeros((len(group), 3)) if seen is None else seen.middle, distance)
        size = np.einsum("nii->ni", V).max(axis=1, initial=0.0)
        steps = np.arange(dof)
        V[:, steps, steps] += np.where(held, 1e6 * np.maximum(size, 1.0)[:, None], 0.0)
        # the root of the summed variances bounds the largest; where that is small, nothing more needs to be known
        inverse = np.empty_like(V)
        inverse[eliminated.order] = -self.system.N[e].reshape(-1, dof, dof)
        bound = np.sqrt(np.maximum(np.einsum("nmi,nij,nmj->n", J, inverse, J, optimize=True), 0.0))
        rank = np.einsum("nij,nji->n", V, inverse)  # of a landmark of which the elimination dropped a direction
        unsure = ~(bound < WEAK) | (rank < dof - 0.5) | held.any(axis=1)
        sigma, moves = np.repeat(bound[:, None], dof, axis=1), np.zeros((len(group), J.shape[1], dof))
        if unsure.any():
            sigma[unsure], moves[unsure] = weakest(V[unsure], J[unsure])
        if group.manifold.kind == "pose" or group.manifold.kind == "plane":
            for i in np.flatnonzero(sigma[:, 0] > UNDETERMINED):
                self._open_variable(name, int(i), moves[i][:, sigma[i] > UNDETERMINED])
            return
        self.weakness[name] = sigma[:, 0]
        centers = np.concatenate(list(self.centers.values())) if self.centers else np.zeros((0, 3))
        if seen is not None:
            self.findings += landmark_findings(
                self.problem, name, seen, centers, sigma[:, 0], self.names, (UNDETERMINED, WEAK)
            )

    # The reduced system

    def _parts(self) -> None:
        """Find groups of kept variables that share nothing."""
        counts = [c.count for c in self.layout.kept]
        first = np.concatenate([[0], np.cumsum(counts)])
        rows = np.concatenate([first[a] + r for (a, _), (r, _) in self.layout.blocks.items()])
        columns = np.concatenate([first[b] + c for (_, b), (_, c) in self.layout.blocks.items()])
        graph = scipy.sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(first[-1], first[-1]))
        _, label = connected_components(graph, directed=False)
        for c, kept in enumerate(self.layout.kept):
            member = kept.members[0]
            if self.problem.variables[member.group].manifold.kind != "pose":
                continue
            part = label[first[c] : first[c + 1]]
            seen = self.system.diagonal(c).sum(axis=1) > 0
            sizes = np.bincount(part[seen])
            sizes = np.sort(sizes[sizes > 0])[::-1]
            if len(sizes) > 1:
                self.findings.append(
                    Finding(
                        "separate_parts", "problem",
                        f"The cameras fall into {len(sizes)} groups that share no landmark (of "
                        f"{few([str(n) for n in sizes])} cameras): each can move, turn and scale on its own. Add "
                        "matches between them.",
                        member.group, values={"parts": float(len(sizes))},
                    )
                )  # fmt: skip

    def _modes(self) -> None:
        layout = self.layout
        unseen = np.concatenate([self.system.diagonal(c).reshape(-1) == 0.0 for c in range(len(layout.kept))])
        S, size = scaled(layout, self._with_open_coordinates(unseen & ~np.concatenate(self.held)))
        G = np.concatenate(self.motions.kept)
        G[unseen] = 0.0
        S = constrained(layout, S, G * size[:, None])
        modes = smallest(layout, Fronts(layout), S)
        self._unseen_variables(unseen & ~np.concatenate(self.held))
        excursions = self._excursions(modes, size)
        largest = np.max([np.abs(part).max(axis=(0, 1), initial=0.0) for part in excursions.values()], axis=0)
        open_modes = largest > UNDETERMINED
        self.open_directions += int(open_modes.sum())
        if not open_modes.any():
            return
        whole = np.zeros(len(modes.values), bool)
        for name, part in excursions.items():
            if self.problem.variables[name].manifold.kind == "pose" and len(part) > 3:
                moving = (np.linalg.norm(part, axis=1) > SHARE * largest).sum(axis=0)
                whole |= open_modes & (moving > MANY * len(part))
        apart = any(finding.kind == "separate_parts" for finding in self.findings)
        if whole.any() and not apart:
            self._whole_modes(excursions, whole)
        local = open_modes & ~whole
        for name, part in excursions.items():
            amount = np.linalg.norm(part[:, :, local], axis=1)
            for i in np.flatnonzero((amount > np.maximum(SHARE * largest[local], UNDETERMINED)).any(axis=1)):
                self._open_variable(name, int(i), part[i][:, local][:, amount[i] > UNDETERMINED])

    def _with_open_coordinates(self, unseen: BoolArray) -> Blocks:
        """Return S without the ones on the diagonal that stand for coordinates of which the data say nothing.

        Variables of which the data say nothing at all keep them; they are reported on their own.
        """
        S = dict(self.system.S)
        for c, kept in enumerate(self.layout.kept):
            part = unseen[kept.start : kept.start + kept.count * kept.width].reshape(kept.count, kept.width)
            part = part & ~part.all(axis=1, keepdims=True)
            if part.any():
                S[c, c] = S[c, c].copy()
                block, k = np.nonzero(part)
                S[c, c][block, k, k] = 0.0
        return S

    def _excursions(self, modes: Modes, size: FloatArray) -> dict[str, FloatArray]:
        """Motion (count, m, modes) of every kept variable in comparable units at one standard deviation."""
        sigma = 1.0 / np.sqrt(np.maximum(modes.values, 1e-16))
        steps = modes.vectors / size[:, None] * sigma
        result = {}
        for c in self.layout.kept:
            blocks = steps[c.start : c.start + c.count * c.width].reshape(c.count, c.width, -1)
            for member in c.members:
                group = self.problem.variables[member.group]
                rows = member.blocks(np.arange(len(group)))
                delta = blocks[rows, member.offset : member.offset + member.dof]
                result[member.group] = self._motion_of_kept(member.group) @ delta
        return result

    def _motion_of_kept(self, name: str) -> FloatArray:
        group = self.problem.variables[name]
        middle, distance = np.tile(self.motions.center, (len(group), 1)), np.full(len(group), self.motions.length)
        if group.manifold.kind == "plane":
            middle = self._on_plane(name, middle)
        return motion(group.manifold, group.state, middle, distance)

    def _on_plane(self, name: str, middle: FloatArray) -> FloatArray:
        """Middle of the points that lie on each plane, where there are any."""
        result, total = middle.copy(), np.zeros(len(middle))
        sums = np.zeros_like(middle)
        for factor in self.problem.factors:
            refs = {self.problem.variables[ref.group].manifold.kind: ref for _, ref in factor.references()}
            if "plane" in refs and "point" in refs and refs["plane"].group == name:
                points = self.problem.variables[refs["point"].group].ambient()[refs["point"].index]
                np.add.at(sums, refs["plane"].index, points)
                np.add.at(total, refs["plane"].index, 1.0)
        result[total > 0] = sums[total > 0] / total[total > 0, None]
        return result

    def _whole_modes(self, excursions: dict[str, FloatArray], whole: BoolArray) -> None:
        """Modes that move many cameras together."""
        count = int(whole.sum())
        calibration = [
            name
            for name, part in excursions.items()
            if self.problem.variables[name].manifold.kind == "intrinsics" and (np.abs(part[:, :, whole]) > 0.05).any()
        ]
        moved = sorted({name for name, part in excursions.items() if (np.abs(part[:, :, whole]) > 0.05).any()})
        text = f"{count} direction{'s' if count > 1 else ''} in which many cameras move together "
        if calibration:
            text += (
                "with the calibration cannot be told apart by the data: focal lengths, principal points and the shape "
                "of the scene compensate each other. Hold the intrinsics, or add views turned or from elsewhere."
            )
        else:
            text += "are not determined: parts of the scene hang together too loosely. Add matches between them."
        kind = "calibration_and_shape" if calibration else "loose_scene"
        self.findings.append(Finding(kind, "problem", text, listing(moved) if moved else "", values={"count": count}))

    def _unseen_variables(self, unseen: BoolArray) -> None:
        for c in self.layout.kept:
            blocks = unseen[c.start : c.start + c.count * c.width].reshape(c.count, c.width)
            for member in c.members:
                rows = member.blocks(np.arange(len(self.problem.variables[member.group])))
                bad = np.flatnonzero(blocks[rows, member.offset : member.offset + member.dof].all(axis=1))
                if len(bad):
                    what = few([self.names(member.group, int(i)) for i in bad])
                    self.open_cameras |= {(member.group, int(i)) for i in bad}
                    self.findings.append(
                        Finding(
                            "no_observations", "problem",
                            f"{first_upper(what)} {'has' if len(bad) == 1 else 'have'} no observations at all.",
                            member.group, tuple(map(int, bad)),
                        )
                    )  # fmt: skip

    def _open_variable(self, name: str, i: int, moves: FloatArray) -> None:
        """Describe a camera, plane, direction or calibration that can move."""
        group = self.problem.variables[name]
        label, kind = first_upper(self.names(name, i)), group.manifold.kind
        U, values, _ = np.linalg.svd(moves, full_matrices=False)
        moves = U[:, values > 0.02 * values[0]]
        if kind == "pose":
            self.open_cameras.add((name, i))
            rotation = group.ambient()[i].reshape(3, 4)[:, :3]
            rows = self._rows_of_cameras()[name][1][i]
            text = f"{label} can {camera_freedom(moves, rotation)} without the data noticing"
            text += f"; it has {int(rows)} measured numbers for 6 unknowns." if rows < 12 else "."
            self.findings.append(Finding("camera_open", "problem", text, name, (i,), {"directions": moves.shape[1]}))
        elif kind == "plane":
            ambient = group.ambient()[i]
            normal = ambient[:3] / np.linalg.norm(ambient[:3])
            text = f"{label} can {plane_freedom(moves, normal)}"
            edge_on, on_it = self._edge_on(name, i), self._landmarks_on(name, i)
            if edge_on:
                text += ": the cameras that see it lie in it, so it is seen edge-on."
            elif on_it:
                text += f": it rests on {on_it} only."
            else:
                text += ": too little lies on it."
            code = "plane_edge_on" if edge_on else "plane_open"
            self.findings.append(Finding(code, "problem", text, name, (i,), {"directions": moves.shape[1]}))
        elif kind in ("intrinsics", "vector"):
            which = np.flatnonzero(np.abs(moves).max(axis=1) > 0.1)
            numbers = few([str(k) for k in which])
            text = f"{label}: the data do not determine parameter{'s' if len(which) > 1 else ''} {numbers}; "
            text += (
                "it and the shape of the scene compensate each other. Hold it, or add views turned or from elsewhere."
            )
            self.findings.append(Finding("parameters_open", "problem", text, name, (i,)))
        else:
            text = f"{label} is not determined by the data."
            self.findings.append(Finding(f"{kind}_open", "problem", text, name, (i,)))

    def _edge_on(self, name: str, i: int) -> bool:
        seen = observers(self.problem, name, self.centers)
        mine = seen.pose[seen.variable == i]
        every = np.concatenate(list(self.centers.values())) if self.centers else np.zeros((0, 3))
        if len(mine) == 0:
            mine = np.arange(len(every))
        ambient = self.problem.variables[name].ambient()[i]
        if len(mine) == 0:
            return False
        off = np.abs(every[mine] @ ambient[:3] + ambient[3]) / np.linalg.norm(ambient[:3])
        middle = self._on_plane(name, np.tile(self.motions.center, (len(self.problem.variables[name]), 1)))[i]
        away = np.linalg.norm(every[mine] - middle, axis=1)
        return bool((off < 0.03 * np.maximum(away, 1e-300)).all())

    def _landmarks_on(self, name: str, i: int) -> str:
        parts = []
        for kind in ("point", "line"):
            found: set[int] = set()
            for factor in self.problem.factors:
                refs = [ref for _, ref in factor.references()]
                mine = [ref for ref in refs if ref.group == name]
                other = [ref for ref in refs if self.problem.variables[ref.group].manifold.kind == kind]
                if mine and other and len(refs) == 2:
                    found |= set(other[0].index[mine[0].index == i].tolist())
            if found:
                parts.append(f"{len(found)} {kind}{'s' if len(found) > 1 else ''}")
        return listing(parts) if parts else ""

    # Cameras

    def _rows_of_cameras(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        """For each group of poses: summed squared weighted residuals, and number of measured numbers, of every pose."""
        if not hasattr(self, "_rows"):
            self._rows = {
                name: (np.zeros(len(centers)), np.zeros(len(centers))) for name, centers in self.centers.items()
            }
            for factor in self.problem.factors:
                refs = {slot.name: ref for slot, ref in factor.references()}
                if len(factor) == 0 or "pose" not in refs or refs["pose"].group not in self._rows or len(refs) < 2:
                    continue
                squares, index = _weighted_squares(factor, self.problem), refs["pose"].index
                sums, rows = self._rows[refs["pose"].group]
                sums += np.bincount(index, weights=squares, minlength=len(sums))
                rows += factor.residual_rank * np.bincount(index, minlength=len(rows))
        return self._rows

    def _cameras(self) -> None:
        for name, (sums, rows) in self._rows_of_cameras().items():
            seen = rows > 0
            if seen.sum() < 2:
                continue
            rms = np.sqrt(sums / np.maximum(rows, 1))
            usual, typical = float(np.median(rms[seen])), float(np.median(rows[seen]))
            self._suspicious(
                "camera_residuals", name, seen & (rms > LARGE * usual) & (rms > 1.5), rms / max(usual, 1e-300),
                "residuals {:.0f} times the usual: wrong matches, or a wrong pose or calibration",
            )  # fmt: skip
            few = seen & (rows < np.maximum(FEW * typical, 12))
            known = np.array([(name, i) in self.open_cameras for i in range(len(rows))])
            self._suspicious("camera_few_observations", name, few & ~known, rows, "only {:.0f} measured numbers")
            self._faint(name, known | few)

    def _faint(self, name: str, known: BoolArray) -> None:
        for c, kept in enumerate(self.layout.kept):
            for member in kept.members:
                if member.group != name:
                    continue
                part = slice(member.offset, member.offset + member.dof)
                held = self.held[c].reshape(kept.count, kept.width)[:, part].any(axis=1)
                information = self.system.S[c, c][: kept.count, part, part]
                sigma, _ = weakest(information, self._motion_of_kept(name))
                usual = float(np.median(sigma[~held, 0])) if (~held).any() else 1.0
                self._suspicious(
                    "camera_faint", name, ~known & ~held & (sigma[:, 0] > FAINT * usual), sigma[:, 0] / usual,
                    "{:.0f} times less certain than the rest",
                )  # fmt: skip

    def _suspicious(self, kind: str, name: str, which: BoolArray, amount: FloatArray, words: str) -> None:
        bad = np.flatnonzero(which)
        if len(bad) == 0:
            return
        bad = bad[np.argsort(-np.abs(amount[bad] - np.median(amount)), kind="stable")]
        words, _, tail = words.partition(": ")
        tail = f": {tail}" if tail else ""
        what = few([f"{self.names(name, int(i))} ({words.format(amount[i])})" for i in bad], 3)
        text = f"{len(bad)} camera{'s' if len(bad) > 1 else ''} stand{'s' if len(bad) == 1 else ''} out: {what}{tail}."
        self.findings.append(
            Finding(kind, "warning", text, name, tuple(map(int, bad)), {"worst": float(amount[bad[0]])})
        )


def _weighted_squares(factor: Any, problem: Problem) -> FloatArray:
    """Squared norm of every residual, divided by the noise, without the loss."""
    ambients = tuple(problem.variables[ref.group].ambient() for _, ref in factor.references())
    residual = np.empty((len(factor), factor.residual_size))
    factor.residuals(factor.prepare(ambients), 0, len(factor), residual)
    information = np.asarray(factor.sqrt_information, dtype=np.float64)
    if information.ndim == 3:
        return (np.einsum("nij,nj->ni", information, residual) ** 2).sum(axis=1)
    return (residual**2).sum(axis=1) * information**2


__all__ = ["Diagnosis", "Finding", "diagnose"]
