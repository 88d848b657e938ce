# SPDX-License-Identifier: BSD-3-Clause
"""How many tuned numbers the source has, and how many of them say where they come from.

What is counted, with the same rules for any version of the code. First the numbers that nothing is said of:

named
    Numbers of constants in capitals at the top of a module, each number of a tuple for itself.
defaults
    Numbers that are defaults of arguments and of fields of dataclasses, but for gates.
floats
    Float literals in functions. In compiled kernels only those in comparisons: the others are their formulas.
integers
    Integer literals from 3 on that something is compared with by order (``<``, ``>=``, ...).

Then those with an origin:

gates
    Fields made by ``gate(...)``, by the first word of their origin.
stated
    Numbers whose comment (above, or behind) says ``derived from``, ``convention:`` or ``cost:``: sizes of pieces of
    work, say, on which no decision about data hangs. And defaults of fields that a user is meant to change
    (options), whose comment says one of these or ``chosen on``. And what no decision about data hangs on by its
    nature, each in a column of its own, so that nothing is hidden:

formats
    Constants whose comment speaks of a *format*; integers in comparisons where files are read (``io``, ``bounded``):
    another number would not read the file.
drawings
    Sizes, colours and roundings of pictures, pages and messages (``viz``, ``io/drawn.py``, ``io/exports``,
    ``cli/shared``): nothing is estimated there.
made
    Data that are made up: synthetic scenes, examples of factors and charts, conformance checks, what is run to compile.
shapes
    Fields marked ``ClassVar`` (rows of a residual, columns of a table), and lengths, dimensions and counts compared
    with less than eight: so many a minimal sample has, or so many names a message. Names that count from 0 on (states).
formulas
    Factors that are units (percent, milli, seconds and minutes, bytes), degrees of a circle and the largest number of
    eight bits anywhere, powers and logarithms of ten, divisors 3, 4, 6, 8 and 12 (means, moments), 1.4826 (the
    deviation of normal noise in median absolute deviations) and versions of Python; in exponents the numbers from 30
    on, which keep them from overflowing (1 + exp(-30) is 1 to 13 digits).

Not counted anywhere: 0, 1, -1, 2 and one half, and numerical guards, which are below 1e-5 or from 1e5 on.

    python benchmarks/tuned_numbers.py [--root DIR] [--by-room] [--list ROOM] [--kind KIND]
"""

from __future__ import annotations

import argparse
import ast
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

KINDS = ("named", "defaults", "floats", "integers")
APART = ("stated", "formats", "drawings", "made", "shapes", "formulas")
TRIVIAL = {0, 1, -1, 2, 0.5, -0.5, -2}
GUARDS = (1e-5, 1e5)
COMPILED = ("kernel", "loop", "njit")
#: Where all numbers are drawings, or data that are made up; where integers in comparisons are formats.
DRAWINGS = re.compile(r"viz/|io/drawn|io/exports/|cli/shared/")
MADE = re.compile(
    r"scene/synthetic/|compilation/runs|adjustment/consistency_scenes|(.*/)?(checks/|check\.py|_examples\.py)|testing\.py"
)
FORMATS = re.compile(r"io/|bounded/")
#: Functions that make data up, inside any module.
EXAMPLES = re.compile(r"(\w+_)?examples?$|random$")
STATED = re.compile(r"\b(derived from|convention:|cost:)", re.IGNORECASE)
UNITS, EVERYWHERE = {100, 1000, 60, 3600, 1024, 1.4826}, {90, 180, 360, 255}
DIVISORS = {3, 4, 6, 8, 12}
MAX_SAMPLE, OVERFLOW = 7, 30
#: Origins of ``groma.gates`` that are no choice on data.
SHARED = {"SEARCH": "cost: time of a search"}
Number: TypeAlias = tuple[str, int, float | str]


def numbers_of(path: Path, name: str = "") -> Iterator[Number]:
    """Yield kind, line and number of all that is counted in a file; of a gate the first word of its origin.

    ``name`` is the path inside the package, which says what kind of room the file is in.
    """
    text = path.read_text(encoding="utf-8")
    tree, lines = ast.parse(text), text.splitlines()
    words: dict[str, object] = dict(SHARED)
    found: list[Number] = []
    for node in tree.body:
        found += _named(node, lines)
        if (
            isinstance(node, ast.Assign)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.targets[0], ast.Name)
        ):
            words[node.targets[0].id] = node.value.value
    found += _inside(tree, False, words, lines)
    for kind, line, value in found:
        stated = kind in KINDS and STATED.search(_beside(line, lines))
        yield "stated" if stated else _in_room(kind, name), line, value


def count(root: str | Path) -> dict[str, Counter[str]]:
    """Count the numbers of a source tree, for each of its rooms (first folder or module)."""
    root = Path(root)
    rooms: dict[str, Counter[str]] = {}
    for path in sorted(root.rglob("*.py")):
        name = path.relative_to(root)
        found = rooms.setdefault(name.parts[0].removesuffix(".py"), Counter())
        for kind, _, value in numbers_of(path, name.as_posix()):
            found[f"gates {value}" if kind == "gates" else kind] += 1
    return rooms


def _in_room(kind: str, name: str) -> str:
    if kind in KINDS:
        if DRAWINGS.match(name):
            return "drawings"
        if MADE.match(name):
            return "made"
        if kind == "integers" and FORMATS.match(name):
            return "formats"
    return kind


def _named(node: ast.stmt, lines: list[str]) -> Iterator[Number]:
    if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
        return
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    names = [name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]
    if names and all(name.isupper() for name in names):
        comment = _comment(node, lines)
        kind = "formats" if re.search(r"\bformat", comment) else "stated" if STATED.search(comment) else "named"
        values = node.value.elts if isinstance(node.value, ast.Tuple) else []
        if [getattr(value, "value", None) for value in values] == list(range(len(values))) != []:
            kind = "shapes"
        yield from ((kind, node.lineno, value) for value in _numbers(node.value))


def _comment(node: ast.stmt, lines: list[str]) -> str:
    """Return what is said of a constant: the lines ``#:`` above it and what stands behind it."""
    above = node.lineno - 1
    while above > 0 and lines[above - 1].lstrip().startswith("#:"):
        above -= 1
    behind = lines[(node.end_lineno or node.lineno) - 1][node.end_col_offset or 0 :]
    return " ".join(line.lstrip(" #:").rstrip() for line in lines[above : node.lineno - 1]) + behind


def _beside(line: int, lines: list[str]) -> str:
    """Return the comment behind a line, or the lines of one directly above it."""
    above = line - 1
    while above > 0 and lines[above - 1].lstrip().startswith("# "):
        above -= 1
    return " ".join([*lines[above : line - 1], lines[line - 1].partition("  # ")[2]])


def _inside(node: ast.AST, compiled: bool, words: dict[str, object], lines: list[str]) -> Iterator[Number]:
    """Walk through classes and functions."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef):
            for item in child.body:
                if isinstance(item, ast.AnnAssign) and item.value is not None:
                    comment = _comment(item, lines)
                    stated = STATED.search(comment) or "chosen on" in comment
                    shape = "ClassVar" in ast.unparse(item.annotation)
                    gate = list(_gate(item, words))
                    kind = "shapes" if shape else "stated" if stated else "defaults"
                    yield from gate or _defaults([item.value], kind)
            yield from _inside(child, False, words, lines)
        elif isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            yield from _function(child, compiled)
        elif isinstance(child, ast.If | ast.Try | ast.With):
            yield from _inside(child, compiled, words, lines)


def _function(node: ast.FunctionDef | ast.AsyncFunctionDef, compiled: bool) -> Iterator[Number]:
    decorators = {name.id for one in node.decorator_list for name in ast.walk(one) if isinstance(name, ast.Name)}
    defaults = [value for value in [*node.args.defaults, *node.args.kw_defaults] if value is not None]
    found = list(_defaults(defaults))
    for statement in node.body:
        found += _literals(statement, compiled or not decorators.isdisjoint(COMPILED))
    made = EXAMPLES.match(node.name)
    yield from (("made" if made else kind, line, value) for kind, line, value in found)


def _gate(item: ast.AnnAssign, words: dict[str, object]) -> Iterator[Number]:
    call = item.value
    if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name) or call.func.id != "gate":
        return
    origin = call.args[-1]
    while isinstance(origin, ast.BinOp):  # begins with a name: NAME + " and more"
        origin = origin.left
    text = words.get(origin.id, "chosen on") if isinstance(origin, ast.Name) else ast.literal_eval(origin)
    yield "gates", item.lineno, str(text).split()[0].rstrip(":")


def _defaults(values: list[ast.expr], kind: str = "defaults") -> Iterator[Number]:
    for value in values:
        yield from ((kind, value.lineno, number) for number in _numbers(value))


def _literals(node: ast.AST, compiled: bool, ordered: bool = False, kind: str = "") -> Iterator[Number]:
    """Yield the literals in a statement; ``kind`` is what they are by where they stand."""
    if isinstance(node, ast.FunctionDef):
        yield from _function(node, compiled)
        return
    if isinstance(node, ast.Call | ast.Compare) and re.search(r"\blog\(10\.0\)$|^sys\.version", ast.unparse(node)):
        return
    if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(".exp"):
        for part in ast.walk(node):
            if isinstance(part, ast.Constant) and _counts(part.value) and part.value >= OVERFLOW:  # type: ignore[operator]
                part.kind = "formulas"
    if isinstance(node, ast.Compare):
        ordered = any(isinstance(one, ast.Lt | ast.LtE | ast.Gt | ast.GtE) for one in node.ops)
        sized = any(_is_size(side) for side in (node.left, *node.comparators))
        for side in (node.left, *node.comparators):
            small = isinstance(side, ast.Constant) and _counts(side.value) and side.value <= MAX_SAMPLE  # type: ignore[operator]
            yield from _literals(side, compiled, ordered, "shapes" if sized and small else kind)
        return
    if isinstance(node, ast.BinOp):
        for side in (node.left, node.right):
            yield from _literals(side, compiled, ordered, "formulas" if _is_formula(node, side) else kind)
        return
    if isinstance(node, ast.Constant) and _counts(node.value):
        kind = "formulas" if node.value in EVERYWHERE or node.kind == "formulas" else kind
        if isinstance(node.value, float) and (ordered or not compiled):
            yield kind or "floats", node.lineno, node.value
        elif isinstance(node.value, int) and ordered and node.value > 2:
            yield kind or "integers", node.lineno, node.value
    if isinstance(node, ast.Subscript):  # the index of a column is no number to compare with
        yield from _literals(node.value, compiled, ordered)
        return
    for child in ast.iter_child_nodes(node):
        yield from _literals(child, compiled, ordered)


def _is_size(node: ast.expr) -> bool:
    """Whether an expression is the length of something, one of its dimensions, or how much of it is true."""
    if isinstance(node, ast.Subscript):
        return _is_size(node.value)
    if isinstance(node, ast.Attribute):
        return node.attr in ("ndim", "shape", "size")
    return isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in ("len", "sum", "count_nonzero")


def _is_formula(node: ast.BinOp, side: ast.expr) -> bool:
    """Whether a literal is a unit, the base of a power, or a whole divisor."""
    value = side.value if isinstance(side, ast.Constant) and _counts(side.value) else None
    if not isinstance(value, int | float):
        return False
    if isinstance(node.op, ast.Pow):
        return side is node.left and value == 10
    divisor = isinstance(node.op, ast.Div) and side is node.right and value in DIVISORS
    return divisor or (isinstance(node.op, ast.Mult | ast.Div) and value in UNITS)


def _numbers(node: ast.expr) -> list[float]:
    """Return the numbers in an expression that is made of literals, tuples, arithmetic and calls of them."""
    calls = [part.func for part in ast.walk(node) if isinstance(part, ast.Call)]
    if any(ast.unparse(call).split(".")[-1] not in ("radians", "array", "float32", "sqrt", "log") for call in calls):
        return []
    allowed = (ast.Constant, ast.Tuple, ast.List, ast.UnaryOp, ast.BinOp, ast.Call, ast.Attribute, ast.Name)
    context = (ast.Load, ast.operator, ast.unaryop, ast.keyword)
    parts = list(ast.walk(node))
    if not all(isinstance(part, allowed + context) for part in parts):
        return []
    return [float(part.value) for part in parts if isinstance(part, ast.Constant) and _counts(part.value)]


def _counts(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return value not in TRIVIAL and GUARDS[0] <= abs(value) < GUARDS[1]


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(__file__).resolve().parents[1] / "src" / "groma"
    parser.add_argument("--root", type=Path, default=default, help="folder of the package (default: this checkout's)")
    parser.add_argument("--by-room", action="store_true", help="one row per room")
    parser.add_argument("--list", metavar="ROOM", help="list file, line, kind and number of one room (. for all)")
    parser.add_argument("--kind", choices=KINDS + APART, help="list this kind alone")
    arguments = parser.parse_args()
    if arguments.list:
        for path in sorted((arguments.root / arguments.list).rglob("*.py")):
            name = path.relative_to(arguments.root).as_posix()
            for kind, line, value in numbers_of(path, name):
                if kind == (arguments.kind or kind):
                    print(f"{name}:{line}: {kind} {value}")
        return
    rooms = count(arguments.root)
    total = sum(rooms.values(), Counter())
    columns = [*KINDS, *sorted(name for name in total if name.startswith("gates")), *APART]
    print(f"{'':14}" + "".join(f"{name.removeprefix('gates '):>11}" for name in columns))
    for name, found in [*(rooms.items() if arguments.by_room else []), ("all", total)]:
        print(f"{name:14}" + "".join(f"{found[column]:11,}" for column in columns))


if __name__ == "__main__":
    main()
