# SPDX-License-Identifier: BSD-3-Clause
"""The size and form of the sources as one table of counts, read from the syntax and not run.

    python benchmarks/code_size.py [--since COMMIT] [--root DIR] [--list ROW] [--rooms] [--kept]

``--since`` shows a commit of this checkout beside it (the state before the house was rebuilt is 961f0a1), ``--root``
counts another checkout, ``--list`` prints what a row counts, ``--rooms`` the source lines of every room. ``--kept``
splits the source lines by room: functions and classes of the commit that are still there, then and now, and new ones.
Two are the same if they have one name, or, where that is gone, more than 55 % of their words in common; each is matched
once, the most alike first.

==========================  ==========================================================================================
Row                         Rule
==========================  ==========================================================================================
lines, source lines         all lines of ``src/groma``, stubs too; those that are neither blank, comment nor docstring
largest room, longest ...   files of a room; lines of a module, and of a function (commands: of its body)
repeated lines              source lines, imports and lone brackets left out, in runs of six or more that stand in the
                            sources twice to the letter
long functions              more than 60 lines from ``def`` to the end, without the docstring
many arguments              ten or more arguments, ``self`` and ``cls`` not counted; in rows of their own kernels
                            (``@kernel``, ``@loop``, ...) and the command line, whose arguments are its options
private imports             imports of an underscored name or module by another package than the one that holds it
optimiser loops             functions with a loop in which a name that contains ``damp`` or ``lambda`` is assigned to:
                            every damped least-squares loop raises and lowers its damping
numbers                     named, defaults, floats in functions, integers in comparisons, gates with origin: by the
                            rules of ``tuned_numbers.py``; the four kinds without an origin summed up in a row
public names                ``groma.__all__``; and functions and classes without underscore in modules without one
==========================  ==========================================================================================
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import subprocess
import tarfile
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias, TypeVar

import tuned_numbers

T = TypeVar("T")
Found: TypeAlias = list[str]
Function: TypeAlias = ast.FunctionDef | ast.AsyncFunctionDef
LONG, MANY, RUN, ALIKE = 60, 10, 6, 0.55
#: The state before the house was rebuilt.
BEFORE = "961f0a1"
#: Decorators of compiled code.
KERNELS = {"exact_kernel", "inline_kernel", "intrinsic", "kernel", "loop", "unrolled_loop"}


@dataclass(frozen=True)
class Module:
    """A source file."""

    name: str
    is_package: bool
    text: str
    tree: ast.Module


def modules_of(root: Path) -> list[Module]:
    """Read the sources of a checkout."""
    found = []
    for path in sorted((root / "src" / "groma").rglob("*.py*")):
        if path.suffix not in (".py", ".pyi"):
            continue
        text = path.read_text(encoding="utf-8")
        path_in_src = path.relative_to(root / "src")
        parts = (path_in_src.with_suffix("") if path.suffix == ".py" else path_in_src).parts
        is_package = parts[-1] == "__init__"
        found.append(Module(".".join(parts[: len(parts) - is_package]), is_package, text, ast.parse(text)))
    return found


def room_of(module: Module) -> str:
    """Return the package that a module is in."""
    return module.name if module.is_package else module.name.rpartition(".")[0]


def docstring_lines(node: ast.AST) -> set[int]:
    """Return the lines of the docstring of a module, class or function."""
    body = getattr(node, "body", [])
    if body and isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant):
        if isinstance(body[0].value.value, str):
            return set(range(body[0].lineno, (body[0].end_lineno or 0) + 1))
    return set()


def source_lines(module: Module, imports: bool = True) -> list[str]:
    """Return the lines that are neither blank, comment nor docstring."""
    return list(source_rows(module, imports).values())


def source_rows(module: Module, imports: bool = True) -> dict[int, str]:
    """Return the lines that are neither blank, comment nor docstring, by number."""
    left_out: set[int] = set()
    for node in ast.walk(module.tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            left_out |= docstring_lines(node)
        elif isinstance(node, (ast.Import, ast.ImportFrom)) and not imports:
            left_out |= set(range(node.lineno, (node.end_lineno or 0) + 1))
    lines = enumerate(map(str.strip, module.text.splitlines()), 1)
    return {number: line for number, line in lines if line and not line.startswith("#") and number not in left_out}


def repeated_lines(modules: list[Module]) -> int:
    """Count the lines in runs that stand in the sources twice, but for the first time."""
    known: set[tuple[str, ...]] = set()
    count = 0
    for module in modules:
        lines = [line for line in source_lines(module, imports=False) if any(map(str.isalnum, line))]
        runs = [tuple(lines[k : k + RUN]) for k in range(len(lines) - RUN + 1)]
        repeated: set[int] = set()
        for k, run in enumerate(runs):
            if k >= RUN:  # runs that overlap are not two
                known.add(runs[k - RUN])
            if run in known:
                repeated.update(range(k, k + RUN))
        known.update(runs)
        count += len(repeated)
    return count


def functions(module: Module) -> Iterator[tuple[str, Function]]:
    """Yield all functions with their names, inner ones too."""

    def inside(node: ast.AST, prefix: str) -> Iterator[tuple[str, Function]]:
        for child in ast.iter_child_nodes(node):
            named = isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef))
            name = f"{prefix}.{child.name}" if named else prefix
            if isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)):
                yield name, child
            yield from inside(child, name)

    return inside(module.tree, module.name)


def function_lines(module: Module) -> int:
    """Return the lines of the longest function of a module; of a command the list of options does not count."""
    body = ".cli." in module.name
    return max(
        (
            (node.end_lineno or 0) - (node.body[0] if body else node).lineno + 1 - len(docstring_lines(node))
            for _, node in functions(module)
        ),
        default=0,
    )


def long_functions(modules: list[Module]) -> Found:
    """Functions of more than sixty lines."""
    return [
        f"{name} ({lines})"
        for module in modules
        for name, node in functions(module)
        if (lines := (node.end_lineno or 0) - node.lineno + 1 - len(docstring_lines(node))) > LONG
    ]


def many_arguments(modules: list[Module], kind: str = "") -> Found:
    """Functions of ten arguments and more: ``kernels``, those of the command line (``cli``), or all others."""
    found = []
    for module in modules:
        for name, node in functions(module):
            every = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            count = sum(argument.arg not in ("self", "cls") for argument in every)
            words = {
                part.id
                for decorator in node.decorator_list
                for part in ast.walk(decorator)
                if isinstance(part, ast.Name)
            }
            here = "cli" if module.name.startswith("groma.cli.") else "kernels" if words & KERNELS else ""
            if count >= MANY and here == kind:
                found.append(f"{name} ({count})")
    return found


def private_imports(modules: list[Module]) -> Found:
    """Imports of underscored names and modules by another package."""
    packages = {module.name for module in modules if module.is_package}
    found = []
    for module in modules:
        for node in ast.walk(module.tree):
            names: list[str] = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            for name in (name for name in names if name.split(".")[0] == "groma"):
                parts = name.split(".")
                hidden = [k for k, part in enumerate(parts) if part.startswith("_") and not part.startswith("__")]
                if not hidden:
                    continue
                owner = ".".join(parts[: hidden[0]])
                owner = owner if owner in packages else owner.rpartition(".")[0]
                if module.name != owner and not module.name.startswith(f"{owner}."):
                    found.append(f"{module.name}: {name}")
    return found


def definitions(root: Path) -> list[tuple[str, str, int, Counter[str]]]:
    """Return room, name without underscores, source lines and words of the functions and classes of all modules."""
    found = []
    for module in modules_of(root):
        rows = source_rows(module)
        for node in module.tree.body:
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
                first = min([node.lineno, *(mark.lineno for mark in node.decorator_list)])
                own = [rows[line] for line in range(first, (node.end_lineno or 0) + 1) if line in rows]
                words = Counter(word for line in own for word in re.findall(r"\w+", line))
                found.append((room_of(module), node.name.strip("_"), len(own), words))
    return found


def kept_lines(commit: str, root: Path) -> dict[str, Counter[str]]:
    """Return the lines of what a commit had and of what is new, by room of today."""
    then, now = at_commit(commit, root, definitions), definitions(root)
    names = [{name for _, name, *_ in side} for side in (then, now)]
    alike = []
    for i, (_, name, _, words) in enumerate(then):
        for j, (_, other, _, others) in enumerate(now):
            if name == other or (name not in names[1] and other not in names[0]):
                share = 2 * (words & others).total() / (words.total() + others.total())
                if share > (0.0 if name == other else ALIKE):
                    alike.append((name == other, share, i, j))
    pairs: dict[int, int] = {}
    taken: set[int] = set()
    for _, _, i, j in sorted(alike, reverse=True):
        if i not in taken and j not in pairs:
            pairs[j] = i
            taken.add(i)
    rooms: dict[str, Counter[str]] = {}
    for j, (room, _, lines, _) in enumerate(now):
        count = rooms.setdefault(room, Counter())
        count += Counter({"then": then[pairs[j]][2], "now": lines}) if j in pairs else Counter({"new": lines})
    rooms["gone"] = Counter(then=sum(lines for i, (_, _, lines, _) in enumerate(then) if i not in taken))
    return rooms


def optimiser_loops(modules: list[Module]) -> Found:
    """Functions with a loop that changes a damping."""

    def changes_damping(loop: ast.AST) -> bool:
        for node in ast.walk(loop):
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            if isinstance(node, (ast.Assign, ast.AugAssign, ast.AnnAssign)):
                for name in (part for target in targets if target is not None for part in ast.walk(target)):
                    word = getattr(name, "id", getattr(name, "attr", ""))
                    if "damp" in word.lower() or "lambda" in word.lower():
                        return True
        return False

    return [
        name
        for module in modules
        for name, node in functions(module)
        if any(isinstance(loop, (ast.For, ast.While)) and changes_damping(loop) for loop in ast.walk(node))
    ]


def top_level_names(modules: list[Module]) -> Found:
    """Names in ``groma.__all__``."""
    trees = {module.name: module.tree.body for module in modules}
    found = []
    for node in trees.get("groma.__init__.pyi", trees["groma"]):
        if isinstance(node, ast.ImportFrom):
            found += [alias.asname for alias in node.names if alias.asname and not alias.asname.startswith("_")]
        elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Name):
            found.append(ast.unparse(node.targets[0]))
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return list(ast.literal_eval(node.value))
    return found


def public_names(modules: list[Module]) -> Found:
    """Functions and classes without underscore in modules without one."""
    return [
        f"{module.name}.{node.name}"
        for module in modules
        if "._" not in module.name
        for node in module.tree.body
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)) and not node.name.startswith("_")
    ]


#: Rows of the table and what they list; the lines are counted apart.
ROWS: dict[str, Callable[[list[Module]], Found]] = {
    "files": lambda modules: [module.name for module in modules],
    "functions": lambda modules: [name for module in modules for name, _ in functions(module)],
    "long functions": long_functions,
    "many arguments": many_arguments,
    "many arguments, kernels": lambda modules: many_arguments(modules, "kernels"),
    "many arguments, command line": lambda modules: many_arguments(modules, "cli"),
    "private imports": private_imports,
    "optimiser loops": optimiser_loops,
    "public names, groma.__all__": top_level_names,
    "public names, all modules": public_names,
}


def counts(root: Path) -> dict[str, int]:
    """Return the table of a checkout."""
    modules = modules_of(root)
    rooms = Counter(map(room_of, modules))
    sizes = {module.name: len(source_lines(module)) for module in modules}
    table = {"lines": sum(len(module.text.splitlines()) for module in modules)}
    table["source lines"] = sum(sizes.values())
    table["source lines, cli"] = sum(size for name, size in sizes.items() if name.startswith("groma.cli"))
    table["repeated lines"] = repeated_lines(modules)
    table["largest room"] = max(rooms.values())
    table["longest module"] = max(len(module.text.splitlines()) for module in modules)
    table["longest function"] = max(map(function_lines, modules))
    table |= {row: len(listed(modules)) for row, listed in ROWS.items()}
    numbers = sum(tuned_numbers.count(root / "src" / "groma").values(), Counter())
    table |= {f"numbers, {kind}": numbers[kind] for kind in tuned_numbers.KINDS}
    table["numbers without an origin"] = sum(numbers[kind] for kind in tuned_numbers.KINDS)
    gates = sum(number for kind, number in numbers.items() if kind.startswith("gates"))
    return table | {"gates with origin": gates - numbers["gates without"]}


def counts_of(commit: str, root: Path) -> dict[str, int]:
    """Return the table of a commit of a checkout."""
    return at_commit(commit, root, counts)


def at_commit(commit: str, root: Path, count: Callable[[Path], T]) -> T:
    """Return what is counted in a commit of a checkout."""
    command = ["git", "-C", str(root), "archive", commit, "src/groma"]
    packed = subprocess.run(command, capture_output=True, check=True).stdout
    with tempfile.TemporaryDirectory() as folder, tarfile.open(fileobj=io.BytesIO(packed)) as archive:
        archive.extractall(folder, filter="data")
        return count(Path(folder))


def main() -> None:
    """Print the table, or what one row counts."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--root", type=Path, default=Path(__file__).resolve().parents[1], help="checkout to measure")
    parser.add_argument("--since", metavar="COMMIT", help="show a commit of the checkout before it")
    parser.add_argument("--list", metavar="ROW", choices=ROWS, help="print what a row counts")
    parser.add_argument("--rooms", action="store_true", help="print the source lines of every room")
    parser.add_argument("--kept", action="store_true", help="print what was there in the commit and what is new")
    arguments = parser.parse_args()
    if arguments.kept:
        rooms = kept_lines(arguments.since or BEFORE, arguments.root)
        rooms["all"] = sum(rooms.values(), Counter())
        print(f"{'':<40}{'then':>8}{'now':>8}{'new':>8}")
        print(*(f"{room:<40}{n['then']:>8,}{n['now']:>8,}{n['new']:>8,}" for room, n in rooms.items()), sep="\n")
        return
    if arguments.rooms:
        rooms = Counter()
        for module in modules_of(arguments.root):
            rooms[room_of(module)] += len(source_lines(module))
        print(*(f"{room:<40}{lines:>8,}" for room, lines in sorted(rooms.items())), sep="\n")
        return
    if arguments.list:
        print(*ROWS[arguments.list](modules_of(arguments.root)), sep="\n")
        return
    tables = [counts_of(arguments.since, arguments.root)] if arguments.since else []
    tables.append(counts(arguments.root))
    for row in tables[-1]:
        print(f"{row:<30}" + "".join(f"{table[row]:>8,}" for table in tables))


if __name__ == "__main__":
    main()
