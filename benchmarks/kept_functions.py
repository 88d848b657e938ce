# SPDX-License-Identifier: BSD-3-Clause
"""Which functions of an earlier commit live on in this checkout, in how many source lines, and how many are new.

    python benchmarks/kept_functions.py [--since COMMIT] [--list WHAT]

A function of today is an earlier one if it has its name (that of its class too, else its own) and at least three tenths
of the lines of both are the same to the letter; or, under another name, five tenths. Otherwise it is new, and an
earlier one that nothing of today is taken for is gone. Lines are counted as in ``code_size.py``; methods are functions,
inner functions belong to the one around them. ``--list`` prints the functions behind ``kept``, ``gone`` or ``new``.
"""

from __future__ import annotations

import argparse
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path

import code_size

#: Share of common lines from which two functions are one: of one name, and of two.
SAME_NAME, OTHER_NAME = 0.3, 0.5
#: Lines that stand in more functions than this, or are shorter, say nothing about which function has another name.
COMMON, SHORT = 20, 8


@dataclass(frozen=True, eq=False)
class Function:
    """A function with its source lines."""

    place: str
    #: Name with that of its class.
    name: str
    lines: tuple[str, ...]

    def common(self, other: Function) -> float:
        """Return the share of the lines of both that are the same."""
        same = Counter(self.lines) & Counter(other.lines)
        return 2.0 * same.total() / max(len(self.lines) + len(other.lines), 1)


def functions_of(modules: list[code_size.Module]) -> list[Function]:
    """Return the functions of modules and classes."""
    found = []
    for module in modules:
        rows, past = code_size.source_rows(module), 0
        for name, node in code_size.functions(module):
            if node.lineno > past:  # not an inner one
                past = node.end_lineno or 0
                lines = tuple(rows[number] for number in range(node.lineno, past + 1) if number in rows)
                found.append(Function(f"{module.name}:{node.lineno}", name.removeprefix(f"{module.name}."), lines))
    return found


def compare(old: list[Function], new: list[Function]) -> tuple[dict[Function, Function], list[Function]]:
    """Return what each function of today was, and those that were nothing."""
    by_name: dict[str, list[Function]] = defaultdict(list)
    for one in old:
        for name in {one.name, one.name.rpartition(".")[2]}:
            by_name[name].append(one)
    was: dict[Function, Function] = {}
    for one in new:
        named = by_name[one.name] or by_name[one.name.rpartition(".")[2]]
        if named and one.common(best := max(named, key=one.common)) >= SAME_NAME:
            was[one] = best
    left = set(old) - set(was.values())
    by_line: dict[str, set[Function]] = defaultdict(set)
    for one in left:
        for line in one.lines:
            by_line[line].add(one)
    for one in (one for one in new if one not in was):
        telling = [line for line in set(one.lines) if len(line) >= SHORT and len(by_line[line]) <= COMMON]
        votes = Counter(other for line in telling for other in by_line[line])
        likely = [other for other, _ in votes.most_common(3) if one.common(other) >= OTHER_NAME]
        if likely:
            was[one] = likely[0]
    return was, [one for one in new if one not in was]


def main() -> None:
    """Print the table, or the functions behind a row."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--since", default="961f0a1", metavar="COMMIT")
    parser.add_argument("--list", choices=("kept", "gone", "new"), metavar="WHAT")
    arguments = parser.parse_args()
    root = Path(__file__).resolve().parents[1]
    old = functions_of(code_size.at_commit(arguments.since, root, code_size.modules_of))
    was, new = compare(old, functions_of(code_size.modules_of(root)))
    gone = sorted(set(old) - set(was.values()), key=lambda one: one.place)
    parts = {"kept, then": set(was.values()), "kept, today": list(was), "gone": gone, "new": new}
    for name, found in parts.items():
        print(f"{name:<14}{len(found):>7,} functions{sum(len(one.lines) for one in found):>9,} source lines")
    for one in {"kept": list(was), "gone": gone, "new": new}.get(arguments.list, ()):
        print(f"{len(one.lines):>5}  {one.place} {one.name}" + (f"  was {was[one].place}" if one in was else ""))


if __name__ == "__main__":
    main()
