# SPDX-License-Identifier: BSD-3-Clause
"""Which variables of a problem are eliminated, and how the others form classes of equally wide blocks."""

from __future__ import annotations

import numpy as np

from groma._typing import IntArray
from groma.errors import ProblemError
from groma.problem.layout import KeptClass, Member
from groma.problem.problem import Problem

#: Kinds of variables that are eliminated where possible.
LANDMARK_KINDS = ("point", "line")
#: Largest number of variables that may be moved to the reduced system without being asked (cost: the reduced system
#: grows with the square).
MAX_KEPT_LANDMARKS = 4000


def free_groups(problem: Problem) -> list[str]:
    """Return the groups that factors refer to and that may move."""
    used = {ref.group for factor in problem.factors if len(factor) for _, ref in factor.references()}
    return [name for name, group in problem.variables.items() if name in used and not group.is_constant]


def couplings(problem: Problem, groups: set[str]) -> list[tuple[str, str, str]]:
    """Return (factor, group, group) for every factor type that touches two variables of the given groups."""
    found = []
    for factor in problem.factors:
        if len(factor) == 0:
            continue
        touched = [ref.group for _, ref in factor.references() if ref.group in groups]
        if len(touched) > 1:
            found.append((factor.type_name, touched[0], touched[1]))
    return found


def choose_landmarks(problem: Problem, eliminate: str | tuple[str, ...], warnings: list[str]) -> tuple[str, ...]:
    """Return the groups that are eliminated; notes about the choice are added to ``warnings``.

    Raises
    ------
    ProblemError
        If ``eliminate`` names a group that is not there, or two that a factor couples.
    """
    free = free_groups(problem)
    if eliminate == "auto":
        if not couplings(problem, set(free)):
            return tuple(free)  # nothing is coupled: every variable is an independent problem
        chosen = [name for name in free if problem.variables[name].manifold.kind in LANDMARK_KINDS]
        while coupled := couplings(problem, set(chosen)):
            name, first, second = coupled[0]
            smaller = min(first, second, key=lambda group: len(problem.variables[group]))
            if len(problem.variables[smaller]) > MAX_KEPT_LANDMARKS:
                raise ProblemError(
                    f"Factor {name!r} couples the landmarks {first!r} and {second!r}; both cannot be eliminated, and "
                    f"{smaller!r} has {len(problem.variables[smaller])} variables, too many to keep in the reduced "
                    f"system unasked. Pass eliminate=({(set(chosen) - {smaller}).pop()!r},) if that is intended."
                )
            chosen.remove(smaller)
            if first != second:
                warnings.append(
                    f"Factor {name!r} couples {first!r} and {second!r}; {smaller!r} stays in the reduced system."
                )
        return tuple(chosen)
    groups = (eliminate,) if isinstance(eliminate, str) else tuple(eliminate)
    for name in groups:
        if name not in problem.variables:
            raise ProblemError(f"eliminate names {name!r}; the problem has the groups {sorted(problem.variables)}.")
    groups = tuple(name for name in groups if name in free)
    for name, first, second in couplings(problem, set(groups)):
        rest = tuple(group for group in groups if group != second) or tuple(g for g in groups if g != first)
        raise ProblemError(
            f"Factor {name!r} couples two eliminated landmarks (groups {first!r} and {second!r}); their blocks are "
            f"then not independent. Keep one of them in the reduced system: eliminate={rest!r}."
        )
    return groups


def _private_intrinsics(problem: Problem, group: str, kept: list[str]) -> tuple[str, IntArray] | None:
    """Find a pose group that uses each variable of ``group`` in exactly one pose, one variable a pose."""
    partner: str | None = None
    uses: list[tuple[IntArray, IntArray]] = []
    for factor in problem.factors:
        refs = {slot.name: ref for slot, ref in factor.references()}
        mine = [ref for ref in refs.values() if ref.group == group]
        if not mine:
            continue
        if len(mine) > 1:
            return None
        poses = [
            ref for ref in refs.values() if ref.group in kept and problem.variables[ref.group].manifold.kind == "pose"
        ]
        if len(refs) > 1:
            if len(poses) != 1 or (partner is not None and poses[0].group != partner):
                return None
            partner = poses[0].group
            uses.append((mine[0].index, poses[0].index))
    count = len(problem.variables[group])
    if partner is None or len(problem.variables[partner]) != count:
        return None
    block_of = np.full(count, -1, np.int32)
    for index, pose in uses:
        block_of[index] = pose
    one_to_one = all(np.array_equal(index, pose) for index, pose in uses)
    if not one_to_one and any((block_of.take(index) != pose).any() for index, pose in uses):
        return None
    return (partner, block_of) if (np.sort(block_of) == np.arange(count)).all() else None


def kept_classes(
    problem: Problem, landmarks: tuple[str, ...]
) -> tuple[tuple[KeptClass, ...], dict[str, tuple[int, int]]]:
    """Return the kept classes, and for each kept group its (class, member)."""
    kept = [name for name in free_groups(problem) if name not in landmarks]
    rank = {"pose": 0, "intrinsics": 1}
    kept.sort(key=lambda name: rank.get(problem.variables[name].manifold.kind, 2))
    hosts: dict[str, list[tuple[str, IntArray]]] = {}
    guests = set()
    for name in kept:
        if problem.variables[name].manifold.kind == "intrinsics":
            found = _private_intrinsics(problem, name, kept)
            if found is not None:
                hosts.setdefault(found[0], []).append((name, found[1]))
                guests.add(name)
    classes: list[KeptClass] = []
    member_of: dict[str, tuple[int, int]] = {}
    start = 0
    for name in kept:
        if name in guests:
            continue
        dof = problem.variables[name].manifold.dof
        members = [Member(name, 0, dof)]
        for guest, block_of in hosts.get(name, []):
            guest_dof = problem.variables[guest].manifold.dof
            members.append(Member(guest, members[-1].offset + members[-1].dof, guest_dof, block_of))
        for m, member in enumerate(members):
            member_of[member.group] = (len(classes), m)
        width = members[-1].offset + members[-1].dof
        count = len(problem.variables[name])
        classes.append(KeptClass(width, count, tuple(members), start))
        start += width * count
    return tuple(classes), member_of
