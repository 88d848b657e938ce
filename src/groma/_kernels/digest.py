# SPDX-License-Identifier: BSD-3-Clause
"""What a compiled function depends on, as a digest.

Kernels are inlined into their callers, and globals are compiled in as constants. So what was compiled is valid as long
as nothing of this changed:

- the bytecode, constants and defaults of the function and its compiler options. Comments, docstrings and line numbers
  are not among them; a kept function may therefore name an older line when it raises;
- what its global names and closure stand for, and what these use in turn: compiled and plain functions, intrinsics,
  the functions registered with ``numba.extending.overload``, classes, numbers, strings, tuples, arrays. Of a module
  those attributes count whose names occur in the code;
- of a table :class:`ByLength`, such as the kernels of camera models, the entries that the argument types select;
- the versions of Python, Numba, llvmlite and NumPy, for everything that is theirs, and Numba's settings;
- the files that change Numba's compiler (``COMPILER``), byte by byte.

Names are taken wherever they occur in the code, also where they are attributes of something else, so that too much
counts rather than too little. What cannot be followed (an instance of some class, ``getattr`` in an overload) stands
for all files of the packages involved. Methods and attributes added to Numba's types (``overload_method``) are not
seen; nothing in groma adds any.

Functions that use each other are a graph. Its digest is that of its nodes in the order in which they are reached, with
the numbers of the nodes that each refers to, so cycles need no special care.

What was found out about a function is kept for the rest of the process, with every name that was looked up and what it
stood for. Arrays, lists and dictionaries can change in place and are read each time. Whatever has changed since it was
first looked at may or may not have been compiled in already; what depends on it gets a digest that no other process
finds.
"""

from __future__ import annotations

import hashlib
import sys
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import CellType, FunctionType
from typing import Any, TypeVar

import llvmlite
import numba
import numpy as np
from numba.core import config, types

from groma._kernels.parts import (
    MISSING,
    Part,
    contents,
    find_overloads,
    is_numba_type,
    is_versioned,
    module_of,
    part_of,
    say,
)

_T = TypeVar("_T")

#: Settings of Numba that change the code, besides the processor.
_SETTINGS = ("OPT", "BOUNDSCHECK", "DEBUGINFO_DEFAULT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "USING_SVML")
#: Files of this room that decide what code comes out of a function.
COMPILER = ("elements.py", "inner.py", "lifetimes.py", "ranges.py", "rewrites.py", "shortcuts.py")
_CHANGE_IN_PLACE = (list, dict, set, np.ndarray)


class ByLength(dict[int, _T]):
    """A table from which an overload takes the entry whose key is the length of a tuple argument.

    Compiled code depends on the entries whose keys occur as lengths of tuples among the types of its arguments, on none
    of the others. Where no length fits, it depends on all.
    """


@dataclass(frozen=True)
class Dependence:
    """What a function, compiled for given argument types, depends on."""

    #: Digest of all of it.
    content: str
    #: Names of the entries of tables that the argument types select.
    selected: tuple[str, ...]
    #: Whether all of it could be followed.
    is_complete: bool


def dependence(function: Any, argument_types: tuple) -> Dependence:
    """Return what a function (compiled or plain) depends on if compiled for argument types."""
    if find_overloads():
        _look_again()
    lengths, made = _inside(argument_types)
    digester = _Digester(lengths, [], [])
    content = _hash([digester.digest(thing) for thing in (function, *made)])
    return Dependence(content, tuple(dict.fromkeys(digester.selected)), not digester.opaque)


def environment() -> tuple:
    """Return versions and settings that everything compiled depends on, and a digest of our part of the compiler."""
    settings = tuple(repr(getattr(config, name, None)) for name in _SETTINGS)
    versions = sys.version_info[:2], numba.__version__, llvmlite.__version__, np.__version__
    return *versions, settings, _compiler()


# --------------------------------------------------------------------------------------------------------- The graph


@dataclass(frozen=True)
class _Reach:
    """All that can be reached from something without passing through a table or what can change in place."""

    text: str
    #: What can change in place, and tables.
    late: tuple[Any, ...]
    #: Lengths of tuples of nothing among the constants, which select from tables as well.
    lengths: frozenset[int]
    packages: frozenset[str]
    is_opaque: bool
    reads: tuple[tuple[Any, str, Any], ...]


#: What was found out, by id; the object is kept so that its id stays its own.
_parts: dict[int, tuple[Any, Part]] = {}
_reaches: dict[int, tuple[Any, _Reach]] = {}


#: How entries of tables, and what can change in place, were first found.
_first: dict[tuple[int, int | None], tuple[Any, Any]] = {}


def _changes(reads: Any) -> Iterator[Any]:
    """Yield what names stood for that now stand for something else; ``MISSING`` where they stood for nothing."""
    for space, name, found in reads:
        now = contents(space) if type(space) is CellType else space.get(name, MISSING)
        if now is not found:
            yield found


def _known_part(thing: Any) -> Part:
    known = _parts.get(id(thing))
    if known is None:
        known = _parts[id(thing)] = thing, part_of(thing)
    elif changes := list(_changes(known[1].reads)):
        known = _parts[id(thing)] = thing, part_of(thing)
        if any(before is not MISSING for before in changes):
            known[1].text.append(uuid.uuid4().hex)
    return known[1]


def _look_again() -> None:
    """Describe everything anew, after overloads were registered."""
    _reaches.clear()
    for key, (thing, before) in list(_parts.items()):
        part = part_of(thing)
        if part.text != before.text:
            part.text.append(uuid.uuid4().hex)
        _parts[key] = thing, part


def _known_reach(thing: Any) -> _Reach:
    known = _reaches.get(id(thing))
    if known is None or any(True for _ in _changes(known[1].reads)):
        known = _reaches[id(thing)] = thing, _walk(thing)
    return known[1]


def _since(thing: Any, key: int | None, state: Any) -> str:
    """Return a text that is empty as long as something in ``thing`` is as it was when first looked at."""
    return "" if _first.setdefault((id(thing), key), (thing, state))[1] == state else uuid.uuid4().hex


def _walk(root: Any) -> _Reach:
    """Number everything in the order in which it is reached, and write down what refers to what."""
    text, late, reads = hashlib.sha256(), [], {}
    lengths: set[int] = set()
    packages: set[str] = set()
    is_opaque = False
    things, places = [root], {id(root): 0}
    for thing in things:  # grows
        if isinstance(thing, _CHANGE_IN_PLACE):
            text.update(b"late;")
            late.append(thing)
            continue
        part = _known_part(thing)
        text.update("".join(part.text).encode())
        for label, other in part.others:
            place = places.setdefault(id(other), len(things))
            if place == len(things):
                things.append(other)
            text.update(f"{label}>{place};".encode())
        lengths |= part.lengths
        packages.add(part.package)
        is_opaque |= part.is_opaque
        reads.update({(id(read[0]), read[1]): read for read in part.reads})
    packages.discard("")
    return _Reach(
        text.hexdigest(), tuple(late), frozenset(lengths), frozenset(packages), is_opaque, tuple(reads.values())
    )


@dataclass(frozen=True)
class _Digester:
    """Puts the digest of something together, for one choice of argument types."""

    #: Lengths of the tuples among the argument types.
    lengths: frozenset[int]
    #: Takes the names of selected entries.
    selected: list[str]
    #: Takes what cannot be followed.
    opaque: list[Any]

    def digest(self, thing: Any, above: tuple[_Reach, ...] = (), within: tuple[int, ...] = ()) -> str:
        """Digest anything; ``above`` and ``within`` say what leads to it, from the outside in."""
        said = say(thing)
        if said is not None:
            return said
        if id(thing) in within:
            return f"again {within.index(id(thing))}"
        within = *within, id(thing)
        if isinstance(thing, ByLength):
            entries = [(length, thing[length]) for length in self._select(thing, above)]
            text = [self.digest(entry, above, within) + _since(thing, n, id(entry)) for n, entry in entries]
            return f"table {text}"
        if isinstance(thing, _CHANGE_IN_PLACE):
            part = part_of(thing)
            text = [*part.text, _since(thing, None, part.text)]
            for number, (label, other) in enumerate(part.others):
                text.append(f"{label}>{self.digest(other, above, within)}{_since(thing, number, id(other))}")
            packages, is_opaque = {part.package}, part.is_opaque
        else:
            reach = _known_reach(thing)
            above = *above, reach
            text = [reach.text, *(self.digest(other, above, within) for other in reach.late)]
            packages, is_opaque = set(), reach.is_opaque
        if is_opaque:
            self.opaque.append(thing)
            packages.update(*(reach.packages for reach in above))
            text += [_stamp(package) for package in sorted(packages - {""}) if not is_versioned(package)]
        return _hash(text)

    def _select(self, table: ByLength, above: tuple[_Reach, ...]) -> list[int]:
        """Return the keys that argument types and tuples written into the code may select; name the former."""
        given = sorted(self.lengths & table.keys()) or sorted(table)
        written = set().union(*(reach.lengths for reach in above)) & table.keys()
        self.selected.extend(self._name(table[length]) for length in given)
        return [*given, *sorted(written.difference(given))]

    def _name(self, entry: Any) -> str:
        function = getattr(entry, "py_func", entry)
        if not isinstance(function, FunctionType):
            return repr(type(entry))
        file = function.__code__.co_filename if function.__module__ == "__main__" else ""
        made = self.digest(function) if function.__closure__ else ""  # its name may be that of many
        return f"{function.__module__}.{function.__qualname__} {file} {made}"


@cache
def _inside(kind: Any) -> tuple[frozenset[int], tuple[Any, ...]]:
    """Look through a type, or tuple of types.

    Returns
    -------
    lengths : frozenset of int
        Lengths of the tuples in it.
    made : tuple
        Classes that are compiled in (of named tuples, enumerations), and types that other packages implement.
    """
    is_type, is_tuple = is_numba_type(kind), type(kind) is tuple
    inner = kind.key if is_type else kind if is_tuple else ()
    items = inner if type(inner) is tuple else () if inner is kind else (inner,)
    found = [_inside(item) for item in items]
    lengths = frozenset((kind.count,) if is_type and issubclass(type(kind), types.BaseTuple) else ())
    is_made = (is_type or isinstance(kind, type)) and not is_versioned(module_of(kind))
    made = (kind,) if is_made else ()
    return lengths.union(*(item[0] for item in found)), made + tuple(thing for item in found for thing in item[1])


def _hash(content: object) -> str:
    return hashlib.sha256(repr(content).encode()).hexdigest()


@cache
def _stamp(package: str) -> str:
    """Return a digest of all files of a package, for what cannot be followed; if it has none, another each time."""
    module = sys.modules.get(package)
    folders = [Path(folder) for folder in getattr(module, "__path__", ())]
    files = [path for folder in folders for path in folder.rglob("*") if path.suffix in (".py", ".so", ".pyd")]
    file = getattr(module, "__file__", None)
    return _content(sorted(files) or [Path(file or "")])


@cache
def _compiler() -> str:
    """Return a digest of our part of the compiler."""
    return _content([Path(__file__).with_name(name) for name in COMPILER])


def _content(files: list[Path]) -> str:
    """Return a digest of files; another each time where they cannot be read."""
    try:
        return _hash([path.read_bytes() for path in files])
    except OSError:
        return uuid.uuid4().hex
