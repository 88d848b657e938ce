# SPDX-License-Identifier: BSD-3-Clause
"""How many tuned numbers the source has, and how many of them say where they come from.

What is counted, with the same rule for any version of the code:

named
    Numbers of constants in capitals at the top of a module, each number of a tuple for itself.
defaults
    Numbers that are defaults of arguments and of fields of dataclasses, but for gates.
floats
    Float literals in functions. In compiled kernels only those in comparisons: the others are their formulas.
integers
    Integer literals from 3 on that something is compared with by order (``<``, ``>=``, ...).
gates
    Fields of ``...Gates`` classes, by the first word of their origin.

Not counted anywhere: 0, 1, -1, 2 and one half, and numerical guards, which are below 1e-5 or from 1e5 on. Counts of
bytes, sizes of drawings and numbers of a file format are counted: no rule tells them from the others.

    python benchmarks/tuned_numbers.py [--root DIR] [--by-room] [--list ROOM]
"""

from __future__ import annotations

import argparse
import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

KINDS = ("named", "defaults", "floats", "integers")
TRIVIAL = {0, 1, -1, 2, 0.5, -0.5, -2}
GUARDS = (1e-5, 1e5)
COMPILED = ("kernel", "loop", "njit")


def numbers_of(path: Path) -> Iterator[tuple[str, int, float | str]]:
    """Yield kind, line and number of all that is counted in a file; of a gate the first word of its origin."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    words = {}
    for node in tree.body:
        yield from _named(node)
        if (
            isinstance(node, ast.Assign)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.targets[0], ast.Name)
        ):
            words[node.targets[0].id] = node.value.value
    yield from _inside(tree, False, words)


def count(root: str | Path) -> dict[str, Counter[str]]:
    """Count the numbers of a source tree, for each of its rooms (first folder or module)."""
    root = Path(root)
    rooms: dict[str, Counter[str]] = {}
    for path in sorted(root.rglob("*.py")):
        found = rooms.setdefault(path.relative_to(root).parts[0].removesuffix(".py"), Counter())
        for kind, _, value in numbers_of(path):
            found[f"gates {value}" if kind == "gates" else kind] += 1
    return rooms


def _named(node: ast.stmt) -> Iterator[tuple[str, int, float | str]]:
    if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
        return
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    names = [name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]
    if names and all(name.isupper() for name in names):
        yield from (("named", node.lineno, value) for value in _numbers(node.value))


def _inside(node: ast.AST, compiled: bool, words: dict[str, object]) -> Iterator[tuple[str, int, float | str]]:
    """Walk through classes and functions."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef):
            gates = child.name.endswith("Gates")
            for item in child.body:
                if isinstance(item, ast.AnnAssign) and item.value is not None:
                    yield from _gate(item, words) if gates else _defaults([item.value])
            yield from _inside(child, False, words)
        elif isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            decorators = {
                name.id for one in child.decorator_list for name in ast.walk(one) if isinstance(name, ast.Name)
            }
            defaults = [value for value in [*child.args.defaults, *child.args.kw_defaults] if value is not None]
            yield from _defaults(defaults)
            inner = compiled or not decorators.isdisjoint(COMPILED)
            for statement in child.body:
                yield from _literals(statement, inner, False)
        elif isinstance(child, ast.If | ast.Try | ast.With):
            yield from _inside(child, compiled, words)


def _gate(item: ast.AnnAssign, words: dict[str, object]) -> Iterator[tuple[str, int, float | str]]:
    call = item.value
    if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name) or call.func.id != "gate":
        return
    origin = call.args[-1]
    while isinstance(origin, ast.BinOp):  # begins with a name: NAME + " and more"
        origin = origin.left
    text = words.get(origin.id, "chosen on") if isinstance(origin, ast.Name) else ast.literal_eval(origin)
    yield "gates", item.lineno, str(text).split()[0].rstrip(":")


def _defaults(values: list[ast.expr]) -> Iterator[tuple[str, int, float | str]]:
    for value in values:
        yield from (("defaults", value.lineno, number) for number in _numbers(value))


def _literals(node: ast.AST, compiled: bool, ordered: bool) -> Iterator[tuple[str, int, float | str]]:
    if isinstance(node, ast.FunctionDef):
        yield from _defaults(list(node.args.defaults))
        for statement in node.body:
            yield from _literals(statement, compiled, False)
        return
    if isinstance(node, ast.Compare):
        ordered = any(isinstance(one, ast.Lt | ast.LtE | ast.Gt | ast.GtE) for one in node.ops)
    if isinstance(node, ast.Constant) and _counts(node.value):
        if isinstance(node.value, float) and (ordered or not compiled):
            yield "floats", node.lineno, node.value
        elif isinstance(node.value, int) and ordered and node.value > 2:
            yield "integers", node.lineno, node.value
    if isinstance(node, ast.Subscript):  # the index of a column is no number to compare with
        yield from _literals(node.value, compiled, ordered)
        return
    for child in ast.iter_child_nodes(node):
        yield from _literals(child, compiled, ordered)


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
    parser.add_argument("--list", metavar="ROOM", help="list file, line, kind and number of one room")
    arguments = parser.parse_args()
    if arguments.list:
        for path in sorted((arguments.root / arguments.list).rglob("*.py")):
            for kind, line, value in numbers_of(path):
                print(f"{path.relative_to(arguments.root)}:{line}: {kind} {value}")
        return
    rooms = count(arguments.root)
    total = sum(rooms.values(), Counter())
    columns = [*KINDS, *sorted(name for name in total if name.startswith("gates"))]
    print(f"{'':14}" + "".join(f"{name:>18}" for name in columns))
    for name, found in [*(rooms.items() if arguments.by_room else []), ("all", total)]:
        print(f"{name:14}" + "".join(f"{found[column]:18,}" for column in columns))


if __name__ == "__main__":
    main()
