# SPDX-License-Identifier: BSD-3-Clause
"""The form of the house, read from the sources: who imports whose underscores, sizes, a contract for every inner room.

Each list of exceptions says what is on it today. It may only become shorter: an entry that is no longer needed fails.
"""

import ast
import re
import runpy
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ROOT / "src"
MODULES = {
    ".".join(path.relative_to(SOURCES).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted((SOURCES / "groma").rglob("*.py"))
}
PACKAGES = sorted(name for name, path in MODULES.items() if path.name == "__init__.py")

MAX_FILES, MAX_LINES, MAX_FUNCTION = 20, 400, 80
#: Files of more lines than allowed, functions of more lines, and underscores that another package imports.
LONG_MODULES: set[str] = set()
LONG_FUNCTIONS: set[str] = set()
BORROWED: set[tuple[str, str]] = set()


@cache
def trees() -> dict[str, ast.Module]:
    return {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in MODULES.items()}


def statements_in(node: ast.AST) -> Iterator[ast.AST]:
    """Yield what is in a module or statement but no expression: these are most of a tree, and hold no statement."""
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.expr):
            yield child


def imported(node: ast.AST) -> Iterator[str]:
    """Yield full names of what a module of groma imports from groma: modules, and names in them."""
    parts = [node]
    while parts:
        node = parts.pop()
        parts += statements_in(node)
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] == "groma")
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "groma":
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def owner_of(name: str) -> str | None:
    """Return the package that an underscored name or module belongs to; None for public names."""
    parts = name.split(".")
    private = [k for k, part in enumerate(parts) if part.startswith("_") and not part.startswith("__")]
    if not private:
        return None
    before = ".".join(parts[: private[0]])
    return before if before in PACKAGES else before.rpartition(".")[0]


def functions(tree: ast.AST, signature: bool = True, prefix: str = "") -> Iterator[tuple[str, int]]:
    """Yield names of functions and their number of lines, without decorators and docstring."""
    for node in statements_in(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            assert node.end_lineno is not None
            lines = node.end_lineno - (node.lineno if signature else node.body[0].lineno) + 1
            first = node.body[0]
            if (
                isinstance(first, ast.Expr)
                and isinstance(first.value, ast.Constant)
                and isinstance(first.value.value, str)
            ):
                assert first.end_lineno is not None
                lines -= first.end_lineno - first.lineno + 1
            yield f"{prefix}{node.name}", lines
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            yield from functions(node, signature, f"{prefix}{node.name}.")
        else:
            yield from functions(node, signature, prefix)


def test_an_underscore_stays_in_its_package():
    borrowed = set()
    for module, tree in trees().items():
        for name in imported(tree):
            owner = owner_of(name)
            if owner is not None and module != owner and not module.startswith(f"{owner}."):
                borrowed.add((module, name))
    assert borrowed == BORROWED


def test_owners_are_told():
    assert owner_of("groma.factors.observations._record.Slot") == "groma.factors.observations"
    assert owner_of("groma.io.bal._head") == "groma.io" and owner_of("groma._counted.counted") == "groma"
    assert owner_of("groma.scene.Scene") is None and owner_of("groma._version.__version__") == "groma"


def imported_when_run(node: ast.AST) -> Iterator[str]:
    """Yield what a module imports from groma, in functions too, except what only type checkers read."""
    for child in statements_in(node):
        if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            continue
        yield from imported(child) if isinstance(child, (ast.Import, ast.ImportFrom)) else imported_when_run(child)


def test_files_do_not_import_each_other_in_circles():
    imports = {module: {*imported_when_run(tree)} - {module} for module, tree in trees().items()}
    modules = {m: {n if n in MODULES else n.rpartition(".")[0] for n in names} for m, names in imports.items()}
    while done := [module for module, names in modules.items() if not names & modules.keys() - {module}]:
        modules = {module: names for module, names in modules.items() if module not in done}
    assert sorted(modules) == []


def test_names_are_listed_where_they_are_supported():
    """Elsewhere the underscore says what is private; a list beside it would say so twice.

    Modules that pass on names of others list them, as nothing else says that these are not just used.
    """
    rooms = runpy.run_path(str(ROOT / "docs" / "_supported_names.py"))["ROOMS"]
    supported = {module for _, modules in rooms for module, names in modules.items() if names is None}
    listing = set()
    for module, tree in trees().items():
        lists = [
            node for node in tree.body if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
        ]
        passed = {
            alias.asname or alias.name for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names
        }
        if lists and passed.isdisjoint(name.value for name in ast.walk(lists[0]) if isinstance(name, ast.Constant)):
            listing.add(module)
    assert listing - set(PACKAGES) - supported == set()


def test_modules_are_short():
    long = {name for name, path in MODULES.items() if len(path.read_text(encoding="utf-8").splitlines()) > MAX_LINES}
    assert long == LONG_MODULES


def test_tests_and_benchmarks_are_short():
    files = [path for folder in ("tests", "benchmarks") for path in (ROOT / folder).rglob("*.py")]
    assert [path.name for path in files if len(path.read_text(encoding="utf-8").splitlines()) > MAX_LINES] == []


def test_functions_are_short():
    """Of commands the list of options does not count: it is the manual."""
    long = {
        f"{module}.{name}"
        for module, tree in trees().items()
        for name, lines in functions(tree, signature=not module.startswith("groma.cli.commands."))
        if lines > MAX_FUNCTION
    }
    assert long == LONG_FUNCTIONS


@pytest.mark.parametrize("room", PACKAGES)
def test_rooms_are_small_and_say_what_they_are(room):
    assert len(list(MODULES[room].parent.glob("*.py"))) <= MAX_FILES
    assert ast.get_docstring(trees()[room])


def test_files_that_are_spoken_of_exist():
    """In the plan of the house, and in what rooms say of themselves."""
    plan = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    found = [(ROOT, name) for name in re.findall(r"`([\w./]+/[\w./]*|[\w/]+\.py)`", plan)]
    for room in PACKAGES:
        said = ast.get_docstring(trees()[room]) or ""
        found += [(MODULES[room].parent, name) for name in re.findall(r"``([\w/]+\.py)``", said)]
    known = {path.relative_to(SOURCES).as_posix() for path in (SOURCES / "groma").rglob("*")}
    missing = [
        (str(place), name)
        for place, name in found
        if not (place / name).exists() and not any(f"/{path}".endswith(f"/{name.rstrip('/')}") for path in known)
    ]
    assert missing == []


@pytest.mark.parametrize(
    "room", [room for room in PACKAGES if any(inner.rpartition(".")[0] == room for inner in PACKAGES)]
)
def test_rooms_with_inner_rooms_have_a_contract(room):
    """Every inner room is in a contract of layers of its room."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    named = {
        name.strip().strip("()")
        for contract in settings["contracts"]
        if contract["type"] == "layers"
        for layer in contract["layers"]
        for name in layer.replace("|", ":").split(":")
    }
    inner = {name for name in PACKAGES if name.rpartition(".")[0] == room} - {"groma.data"}
    assert [name for name in inner if not any(f"{layer}.".startswith(f"{name}.") for layer in named)] == []
