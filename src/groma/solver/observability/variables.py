# SPDX-License-Identifier: BSD-3-Clause
"""Cameras, planes, calibrations and directions that can move without the data noticing, in words."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from groma._counted import counted
from groma._typing import FloatArray
from groma.cameras import model
from groma.solver.linear.visible_motion import observers
from groma.solver.observability.findings import Finding, few, first_upper
from groma.solver.observability.gates import DIAGNOSIS
from groma.solver.observability.inspection import Inspection
from groma.solver.observability.messages import camera_freedom, listing, plane_freedom


def variable_findings(inspection: Inspection, moves: dict[tuple[str, int], FloatArray]) -> list[Finding]:
    """Describe what can move; ``moves`` (m, k) are the motions of each variable at one standard deviation."""
    by_group: dict[str, list[tuple[int, FloatArray]]] = defaultdict(list)
    for (name, i), motions in sorted(moves.items(), key=lambda item: item[0]):
        U, values, _ = np.linalg.svd(motions, full_matrices=False)
        # directions that move with another one, but less than an undetermined one must, are not unobservable themselves
        free = U[:, (values > DIAGNOSIS.undetermined) & (values > DIAGNOSIS.open_share * values[0])]
        if free.shape[1]:
            by_group[name].append((i, free))
    describe = {"pose": _cameras, "plane": _planes, "intrinsics": _parameters, "vector": _parameters}
    findings = []
    for name, found in by_group.items():
        kind = inspection.problem.variables[name].manifold.kind
        findings += describe.get(kind, _others)(inspection, name, found)
    return findings


def _cameras(inspection: Inspection, name: str, found: list[tuple[int, FloatArray]]) -> list[Finding]:
    if len(found) > DIAGNOSIS.one_by_one:
        return [
            _many(inspection, "camera_unobservable", name, found, "cameras can move or turn without the data noticing")
        ]
    rotations = inspection.problem.variables[name].ambient().reshape(-1, 3, 4)[:, :, :3]
    findings = []
    for i, moves in found:
        rows = int(inspection.residuals_of_cameras[name][1][i]) if name in inspection.centers else 0
        label = first_upper(inspection.names(name, i))
        text = f"{label} can {camera_freedom(moves, rotations[i])} without the data noticing"
        text += f"; it has {rows} measured numbers for 6 unknowns." if rows < DIAGNOSIS.min_numbers else "."
        findings.append(Finding("camera_unobservable", "problem", text, name, (i,), {"directions": moves.shape[1]}))
    return findings


def _planes(inspection: Inspection, name: str, found: list[tuple[int, FloatArray]]) -> list[Finding]:
    if len(found) > DIAGNOSIS.one_by_one:
        return [_many(inspection, "plane_unobservable", name, found, "planes are not held by what lies on them")]
    ambient = inspection.problem.variables[name].ambient()
    findings = []
    for i, moves in found:
        text = f"{first_upper(inspection.names(name, i))} can {plane_freedom(moves, ambient[i, :3])}"
        edge_on, on_it = _edge_on(inspection, name, i), _landmarks_on(inspection, name, i)
        if edge_on:
            text += ": the cameras that see it lie in it, so it is seen edge-on."
        else:
            text += f": it rests on {on_it} only." if on_it else ": too little lies on it."
        code = "plane_edge_on" if edge_on else "plane_unobservable"
        findings.append(Finding(code, "problem", text, name, (i,), {"directions": moves.shape[1]}))
    return findings


def _parameters(inspection: Inspection, name: str, found: list[tuple[int, FloatArray]]) -> list[Finding]:
    """One sentence for all calibrations of which the same parameters are unobservable."""
    words = parameter_names(inspection, name)
    alike: dict[tuple[int, ...], list[int]] = defaultdict(list)
    for i, moves in found:
        size = np.abs(moves).max(axis=1)
        alike[tuple(np.flatnonzero(size > DIAGNOSIS.little * size.max()).tolist())].append(i)
    findings = []
    for which, members in alike.items():
        known = [words[k] for k in which] if words else [f"parameter {k}" for k in which]
        several = len(which) > 1
        text = (
            f"{first_upper(few([inspection.names(name, i) for i in members]))}: the data do not determine "
            f"{listing(known)}; the shape of the scene makes up for {'them' if several else 'it'}. Hold "
            f"{'them' if several else 'it'}, or add views turned or from elsewhere."
        )
        findings.append(Finding("parameters_unobservable", "problem", text, name, tuple(members)))
    return findings


def _others(inspection: Inspection, name: str, found: list[tuple[int, FloatArray]]) -> list[Finding]:
    kind = inspection.problem.variables[name].manifold.kind
    names = few([inspection.names(name, i) for i, _ in found])
    text = f"{first_upper(names)} {'is' if len(found) == 1 else 'are'} not determined by the data."
    return [Finding(f"{kind}_unobservable", "problem", text, name, tuple(i for i, _ in found))]


def _many(inspection: Inspection, code: str, name: str, found: list[tuple[int, FloatArray]], words: str) -> Finding:
    indices = tuple(i for i, _ in found)
    text = f"{len(found):,} {words} ({few([inspection.names(name, i) for i in indices])})."
    return Finding(code, "problem", text, name, indices)


def parameter_names(inspection: Inspection, name: str) -> tuple[str, ...]:
    """Names of the parameters of a group of intrinsics, from the camera model of the factors that use it."""
    for factor in inspection.problem.factors:
        used = getattr(factor, "camera_model", None)
        if used is not None and any(ref.group == name for _, ref in factor.references()):
            return tuple((model(used) if isinstance(used, str) else used).parameter_names)
    return ()


def _edge_on(inspection: Inspection, name: str, i: int) -> bool:
    seen = observers(inspection.problem, name, inspection.centers)
    centers = inspection.all_centers
    mine = seen.pose[seen.variable == i]
    centers = centers[mine] if len(mine) else centers
    if len(centers) == 0:
        return False
    ambient = inspection.problem.variables[name].ambient()[i]
    off = np.abs(centers @ ambient[:3] + ambient[3]) / np.linalg.norm(ambient[:3])
    away = np.linalg.norm(centers - inspection.on_planes(name)[i], axis=1)
    return bool((off < DIAGNOSIS.edge_on * np.maximum(away, 1e-300)).all())


def _landmarks_on(inspection: Inspection, name: str, i: int) -> str:
    parts = []
    for kind in ("point", "line"):
        found: set[int] = set()
        for factor in inspection.problem.factors:
            refs = [ref for _, ref in factor.references()]
            mine = [ref for ref in refs if ref.group == name]
            other = [ref for ref in refs if inspection.problem.variables[ref.group].manifold.kind == kind]
            if mine and other and len(refs) == 2:
                found |= set(other[0].index[mine[0].index == i].tolist())
        if found:
            parts.append(counted(len(found), f"{kind}s"))
    return listing(parts) if parts else ""
