# SPDX-License-Identifier: BSD-3-Clause
"""What the reduced system cannot determine: parts that share nothing, variables that nothing sees, and weak modes."""

from __future__ import annotations

import numpy as np

from groma._rows import connected_parts, pointers_of
from groma._typing import BoolArray, FloatArray
from groma.solver.linear.blocks import Blocks
from groma.solver.linear.modes import Modes, divided, scaled
from groma.solver.observability.findings import Finding, few, first_upper
from groma.solver.observability.gates import DIAGNOSIS
from groma.solver.observability.inspection import Inspection
from groma.solver.observability.messages import listing
from groma.solver.observability.variables import parameter_names
from groma.solver.observability.weak_modes import weak_modes

#: What is left of a diagonal after elimination counts as rounding below this share.
ROUNDING = 1e-10
#: Eigenvalues below this count as much: their vectors are not exact.
LEAST = 1e-13


def separate_parts(inspection: Inspection) -> list[Finding]:
    """Find groups of kept variables that share nothing."""
    layout, findings = inspection.layout, []
    first = pointers_of([c.count for c in layout.kept])
    rows = np.concatenate([first[a] + r for (a, _), (r, _) in layout.blocks.items()])
    columns = np.concatenate([first[b] + c for (_, b), (_, c) in layout.blocks.items()])
    label = connected_parts(rows, columns, int(first[-1]))
    for c, (kept, kind) in enumerate(zip(layout.kept, layout.kinds, strict=True)):
        if kind != "pose":
            continue
        seen = inspection.system.diagonal(c).sum(axis=1) > 0
        sizes = np.bincount(label[first[c] : first[c + 1]][seen])
        sizes = np.sort(sizes[sizes > 0])[::-1]
        if len(sizes) > 1:
            of = few([f"{n:,}" for n in sizes])
            text = (
                f"The cameras fall into {len(sizes):,} groups that share no landmark (of {of} cameras): each can move, "
                "turn and scale on its own. Add matches between them."
            )
            findings.append(
                Finding("separate_parts", "problem", text, kept.members[0].group, values={"parts": float(len(sizes))})
            )
    return findings


def unseen_variables(inspection: Inspection) -> tuple[list[Finding], set[tuple[str, int]]]:
    """Find variables without any information from the data."""
    findings, found = [], set()
    unseen = _unseen(inspection)
    for name, at in inspection.layout.unknowns.items():
        kind = inspection.layout.problem.variables[name].manifold.kind
        bad = np.flatnonzero(unseen[at].all(axis=1))
        if len(bad) == 0:
            continue
        whole = [inspection.parts.whole(name, int(i)) for i in bad]
        found |= {*whole}
        what, one = first_upper(few([inspection.names(*variable) for variable in whole])), len(bad) == 1
        if kind in ("plane", "direction"):
            use = "lies on" if kind == "plane" else "runs along"
            text = f"Nothing {use} {what[:1].lower()}{what[1:]}: {'it takes' if one else 'they take'} no part."
            severity, code = "warning", f"{kind}_unused"
        else:
            text = f"{what} {'has' if one else 'have'} no observations at all."
            severity, code = "problem", "no_observations"
        findings.append(Finding(code, severity, text, whole[0][0], tuple(i for _, i in whole)))
    return findings, found


def unobservable_modes(
    inspection: Inspection, apart: bool
) -> tuple[list[Finding], dict[tuple[str, int], FloatArray], int]:
    """Find the motions of kept variables that are not determined with the scene held.

    Returns
    -------
    tuple
        A finding on modes of many cameras, unless the scene is in parts anyway (``apart``); of each variable that can
        move otherwise its motions (m, k) at one standard deviation; and the number of unobservable modes, without
        those of landmarks alone.
    """
    layout, problem = inspection.layout, inspection.problem
    unseen = _unseen(inspection)
    S = _with_open_coordinates(inspection, unseen)
    # where nothing but rounding is left of the diagonal, that of the system before elimination gives the scale
    size = np.maximum(scaled(layout, S)[1], np.sqrt(ROUNDING * inspection.system.flat_diagonal()))
    G = np.where((unseen | inspection.held)[:, None], 0.0, inspection.free_motions[1])
    modes = weak_modes(layout, divided(layout, S, size), size, G)
    if len(modes.values) == 0:
        return [], {}, 0
    excursions = _excursions(inspection, modes, size)
    if not excursions:
        return [], {}, 0
    kinds = {name: problem.variables[name].manifold.kind for name in excursions}
    largest = np.max([np.abs(part).max(axis=(0, 1), initial=0.0) for part in excursions.values()], axis=0)
    unobservable = largest > DIAGNOSIS.undetermined
    if not unobservable.any():
        return [], {}, 0
    whole = np.zeros(len(unobservable), bool)
    for name, part in excursions.items():
        if kinds[name] == "pose" and len(part) > 3:
            moving = (np.linalg.norm(part, axis=1) > DIAGNOSIS.takes_part * largest).sum(axis=0)
            whole |= unobservable & (moving > DIAGNOSIS.whole * len(part))
    findings = [_whole_modes(inspection, excursions, whole)] if whole.any() and not apart else []
    local, moves = unobservable & ~whole, {}
    for name, part in excursions.items():
        amount = np.linalg.norm(part[:, :, local], axis=1)
        for i in np.flatnonzero(
            (amount > np.maximum(DIAGNOSIS.takes_part * largest[local], DIAGNOSIS.undetermined)).any(axis=1)
        ):
            moves[name, int(i)] = part[i][:, local]
    return findings, moves, int(unobservable.sum())


def _unseen(inspection: Inspection) -> BoolArray:
    """Return which unknowns, not held, take no part in any residual."""
    return (inspection.system.flat_diagonal() == 0.0) & ~inspection.held


def _with_open_coordinates(inspection: Inspection, unseen: BoolArray) -> Blocks:
    """Return S without the ones on the diagonal of coordinates without information.

    Variables without any information keep them; they are reported separately.
    """
    S = dict(inspection.system.S)
    for c, kept in enumerate(inspection.layout.kept):
        part = kept.blocks_of(unseen)
        part = part & ~part.all(axis=1, keepdims=True)
        if part.any():
            S[c, c] = S[c, c].copy()
            block, k = np.nonzero(part)
            S[c, c][block, k, k] = 0.0
    return S


def _excursions(inspection: Inspection, modes: Modes, size: FloatArray) -> dict[str, FloatArray]:
    """Motion (count, m, modes) of kept variables in comparable units at one standard deviation, cut; no landmarks."""
    sigma = 1.0 / np.sqrt(np.maximum(modes.values, LEAST))
    steps = modes.vectors * (1.0 / size)[:, None]
    steps *= sigma
    steps[inspection.held] = 0.0  # ones on the diagonal have no unit
    result = {}
    for name, at in inspection.layout.unknowns.items():
        if inspection.layout.problem.variables[name].manifold.kind not in ("point", "line"):
            result[name] = inspection.motion_of(name) @ steps[at]
    if not result:
        return {}
    largest = np.max([np.abs(part).max(axis=(0, 1), initial=0.0) for part in result.values()], axis=0)
    return {
        name: part * np.minimum(1.0, DIAGNOSIS.largest_motion / np.maximum(largest, 1e-300))
        for name, part in result.items()
    }


def _whole_modes(inspection: Inspection, excursions: dict[str, FloatArray], whole: BoolArray) -> Finding:
    """Describe modes that move many cameras together."""
    count = int(whole.sum())
    moved = {name: np.abs(part[:, :, whole]).max(axis=(0, 2)) for name, part in excursions.items() if len(part)}
    moved = {name: size for name, size in moved.items() if size.max() > DIAGNOSIS.takes_part}
    parameters: list[str] = []
    for name, size in moved.items():
        if inspection.problem.variables[name].manifold.kind == "intrinsics":
            words = parameter_names(inspection, name) or tuple(f"parameter {k}" for k in range(len(size)))
            parameters += [words[k] for k in np.flatnonzero(size > DIAGNOSIS.takes_part) if words[k] not in parameters]
    ways = f"in {count:,} ways" if count > 1 else "in one way"
    if parameters:
        text = (
            f"The calibration ({listing(parameters)}) and the shape of the scene make up for each other {ways}: many "
            "cameras can move together without the data noticing. Hold the intrinsics, or add views turned or from "
            "elsewhere."
        )
    else:
        text = (
            f"Many cameras can move together {ways} without the data noticing: parts of the scene hang together too "
            "loosely. Add matches between them."
        )
    kind = "calibration_and_shape" if parameters else "loose_scene"
    return Finding(kind, "problem", text, listing(sorted(moved)) if moved else "", values={"count": count})
