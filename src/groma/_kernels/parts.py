# SPDX-License-Identifier: BSD-3-Clause
"""One thing that compiled code uses: what it is by itself, and what it refers to; see :mod:`groma._kernels.digest`."""

from __future__ import annotations

import builtins
import dis
import enum
import hashlib
import importlib.util
import os
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache
from types import (
    CellType,
    CodeType,
    EllipsisType,
    FunctionType,
    GetSetDescriptorType,
    MemberDescriptorType,
    ModuleType,
    NoneType,
)
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.core.dispatcher import Dispatcher
from numba.core.extending import _Intrinsic
from numba.core.typing.templates import _OverloadFunctionTemplate, builtin_registry

_VERSIONED = ("builtins", "numba", "numpy", "llvmlite")
#: With these, code reaches what its names do not tell.
_OPAQUE = frozenset(("getattr", "globals", "vars", "eval", "exec", "__import__", "import_module", "modules"))
_OPTIMIZED_CODE, _HAS_DOCSTRING = 0x1, 0x4000000
_LOADS_FIRST_CONSTANT = tuple(bytes((operation, 0)) for operation in dis.hasconst)
_LOAD_CONSTANT = dis.opmap["LOAD_CONST"]
_TAKES_APART = [dis.opmap.get(name) for name in ("BINARY_SUBSCR", "STORE_SUBSCR", "UNPACK_SEQUENCE")]
_ADDS_TO_ELEMENT = [bytes((dis.opmap["COPY"], 2))]
if "BINARY_SUBSCR" not in dis.opmap:  # from Python 3.14
    _ADDS_TO_ELEMENT.append(bytes((dis.opmap["BINARY_OP"], 26)))
_LITERALS = (NoneType, bool, int, float, complex, str, bytes, EllipsisType, range, slice)
_NUMBERS = (bool, int, float)
_CLASS_NOISE = ("__doc__", "__dict__", "__weakref__", "__annotations__", "__firstlineno__")
_STANDARD_LIBRARY = os.path.dirname(os.__file__), os.path.join(sys.base_prefix, "DLLs")
MISSING = object()


@dataclass
class Part:
    """One node: what it is by itself, and what it refers to."""

    text: list[str] = field(default_factory=list)
    #: What it refers to, each with a label.
    others: list[tuple[str, Any]] = field(default_factory=list)
    #: Namespaces and closure cells, names, and what was found there.
    reads: list[tuple[Any, str, Any]] = field(default_factory=list)
    #: Lengths of the tuples of nothing, ``None`` or zero, among its constants.
    lengths: set[int] = field(default_factory=set)
    #: The package it is from; empty for values.
    package: str = ""
    #: Whether it refers to something that cannot be followed.
    is_opaque: bool = False

    def add(self, label: str, value: Any) -> None:
        """Add something that it refers to."""
        said = say(value)
        self.text.append(f"{label}={said};")
        if said is None:
            self.others.append((label, value))
        self.lengths.update(_zeros(value))

    def look_up(self, space: Any, names: Iterable[str], prefix: str = "", within: tuple[str, ...] = ()) -> None:
        """Add what names stand for in a namespace; of modules, their attributes of these names."""
        for name in names:
            found = space.get(name, MISSING)
            self.reads.append((space, name, found))
            if found is MISSING and not prefix:
                found = getattr(builtins, name, MISSING)
            if found is MISSING:
                continue
            if not isinstance(found, ModuleType):
                self.add(prefix + name, found)
            elif is_versioned(found.__name__):
                self.text.append(f"{prefix}{name}=module {found.__name__};")
                values = [vars(found).get(other) for other in names]
                for number, value in enumerate(values):
                    if id(value) in _overloads:
                        self.add(f"{prefix}{name} {number}", value)
            elif found.__name__ not in within:
                self.is_opaque |= hasattr(found, "__getattr__")
                self.look_up(vars(found), names, f"{prefix}{name}.", (*within, found.__name__))


def part_of(thing: Any) -> Part:
    """Describe anything that is not a plain value."""
    part = Part()
    if (name := _versioned_name(thing)) is not None:
        part.text.append(name)
    elif isinstance(thing, Dispatcher):
        pipeline = thing._compiler.pipeline_class.__name__  # type: ignore[attr-defined]
        part.text.append(f"compiled {pipeline} {_say_options(thing.targetoptions)} {_say_options(thing.locals)}")
        part.add("function", thing.py_func)
    elif isinstance(thing, _Intrinsic):
        part.text.append(f"intrinsic {_say_options(thing._ctor_kwargs)} {thing._prefer_literal}")
        part.add("function", thing._defn)
    elif isinstance(thing, type) and issubclass(thing, _OverloadFunctionTemplate):
        template: Any = thing
        options = template._jit_options, template._strict, template.prefer_literal, template.metadata
        part.text.append(f"overload {' '.join(map(_say_options, options))}")
        part.add("inline", template._inline.value)
        part.add("function", template._overload_func)
    elif isinstance(thing, FunctionType):
        _describe_function(part, thing)
    elif isinstance(thing, enum.Enum):
        part.text.append(f"member {thing.name}")
        part.add("value", thing.value)
        part.add("class", type(thing))
    elif isinstance(thing, type):
        _describe_class(part, thing)
    elif type(thing) in (tuple, list, dict):
        pairs = thing.items() if isinstance(thing, dict) else enumerate(thing)
        for number, (key, value) in enumerate(pairs):
            part.add(f"{type(thing).__name__} key {number}", key)
            part.add(f"value {number}", value)
    elif type(thing) is set and (said := say(frozenset(thing))) is not None:
        part.text.append(f"set {said}")
    elif type(thing) is np.ndarray and not thing.dtype.hasobject:
        flags = thing.flags
        part.text.append(f"array {thing.dtype!r} {thing.shape} {flags.c_contiguous} {flags.f_contiguous} ")
        part.text.append(hashlib.sha256(thing.tobytes()).hexdigest())
    else:
        module = module_of(thing)
        part.text.append(f"{module}.{type(thing).__qualname__}")
        part.package, part.is_opaque = "" if is_versioned(module) else top(module), True
    for number, template in enumerate(_overloads.get(id(thing), ())):
        part.add(f"overload {number}", template)
    return part


def _describe_function(part: Part, function: FunctionType) -> None:
    code = function.__code__
    names = tuple(_names(code))
    part.package = top(function.__module__ or "__main__")
    part.text.append(f"function {function.__module__}.{function.__qualname__} {_say_code(code)}")
    for number, default in enumerate(function.__defaults__ or ()):
        part.add(f"default {number}", default)
    for name, default in (function.__kwdefaults__ or {}).items():
        part.add(f"default {name}", default)
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        found = contents(cell)
        part.reads.append((cell, name, found))
        part.add(f"closure {name}", None if found is MISSING else found)
    part.look_up(function.__globals__, names)
    for inner in _nested(code):
        part.lengths.update(_written_zeros(inner))
    part.is_opaque |= not _OPAQUE.isdisjoint(names) or any(not is_versioned(name) for name in _imports(code))


def _describe_class(part: Part, thing: type) -> None:
    """Describe a class that an overload or intrinsic uses, by everything in it."""
    part.package = top(thing.__module__)
    part.text.append(f"class {thing.__module__}.{thing.__qualname__}")
    for number, base in enumerate(thing.__bases__):
        part.add(f"base {number}", base)
    if issubclass(thing, enum.Enum):
        for name, member in thing.__members__.items():
            part.add(name, member.value)
        return
    for name, value in vars(thing).items():
        part.reads.append((vars(thing), name, value))
        if isinstance(value, (staticmethod, classmethod)):
            part.add(f"{type(value).__name__} {name}", value.__func__)
        elif isinstance(value, property):
            for kind in ("fget", "fset", "fdel"):
                part.add(f"{kind} {name}", getattr(value, kind))
        elif isinstance(value, (MemberDescriptorType, GetSetDescriptorType)):
            part.text.append(f"slot {name}")
        elif name not in _CLASS_NOISE:
            part.add(name, value)


# ------------------------------------------------------------------------------------------------------ Plain values


def say(value: Any) -> str | None:
    """Describe a value that refers to nothing; None for all others."""
    kind = type(value)
    if kind in _LITERALS:
        return f"{kind.__name__} {value!r}"
    if kind is tuple or kind is frozenset:
        said = [say(item) for item in value]
        if None in said:
            return None
        return f"{kind.__name__} {said if kind is tuple else sorted(map(str, said))}"
    if isinstance(value, np.generic) and not value.dtype.hasobject:
        return f"{value.dtype!r} {value.tobytes().hex()}"
    if is_numba_type(value) or (isinstance(value, (np.dtype, ir.Type)) and kind is not ir.IdentifiedStructType):
        said = f"{kind.__module__}.{kind.__qualname__} {value!r}"
        return None if " at 0x" in said or not is_versioned(kind.__module__) else said
    if isinstance(value, ModuleType):
        return f"module {value.__name__}" if is_versioned(value.__name__) else None
    return None if id(value) in _overloads else _versioned_name(value)


def _versioned_name(value: Any) -> str | None:
    """Name a function or class of a library whose version is known; None for all others."""
    module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", getattr(value, "__name__", None))
    if not isinstance(module, str) or not isinstance(name, str) or not is_versioned(module):
        return None
    found: Any = sys.modules.get(module)
    for step in name.split("."):
        found = getattr(found, step, None)
    return f"{module}.{name}" if found is value else None  # a function inside a function may hold anything


def _say_options(options: Any) -> str:
    """Describe compiler options, sets in order."""
    if isinstance(options, dict):
        return str([(name, _say_options(options[name])) for name in sorted(options)])
    return str(sorted(map(repr, options))) if isinstance(options, (set, frozenset)) else repr(options)


def _say_code(code: CodeType) -> str:
    """Describe code without its docstring, its place and its line numbers."""
    constants = [_say_code(item) if isinstance(item, CodeType) else say(item) for item in code.co_consts]
    if _has_docstring(code) and not any(load in code.co_code for load in _LOADS_FIRST_CONSTANT):
        constants[0] = say(None)  # as if there were none
    counts = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
    names = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
    return repr((code.co_code, code.co_exceptiontable, counts, names, constants))


def _has_docstring(code: CodeType) -> bool:
    if sys.version_info >= (3, 13):
        return bool(code.co_flags & _HAS_DOCSTRING)
    is_function = code.co_flags & _OPTIMIZED_CODE and not code.co_name.startswith("<")
    return bool(is_function and code.co_consts) and isinstance(code.co_consts[0], str)


def _nested(code: CodeType) -> Iterable[CodeType]:
    """Return code and all code inside it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _nested(constant)


def _names(code: CodeType) -> dict[str, None]:
    return dict.fromkeys(name for part in _nested(code) for name in part.co_names)


def _imports(code: CodeType) -> list[str]:
    """Return the modules that code imports when it runs."""
    importing = [part for part in _nested(code) if dis.opmap["IMPORT_NAME"] in part.co_code[::2]]
    return [step.argval for part in importing for step in dis.get_instructions(part) if step.opname == "IMPORT_NAME"]


def _zeros(value: Any) -> Iterable[int]:
    """Yield the lengths of the tuples of nothing in a value, which may select from a table."""
    if type(value) is tuple and value:
        if all(item is None or (type(item) in _NUMBERS and item == 0) for item in value):
            yield len(value)
        for item in value:
            yield from _zeros(item)


def _written_zeros(code: CodeType) -> Iterable[int]:
    """Yield the lengths of tuples of nothing written in code, other than in ``J[0, 0]`` and ``x, y = 0, 0``."""
    for number, constant in enumerate(code.co_consts):
        lengths = list(_zeros(constant))
        if lengths and (type(constant[0]) is tuple or number > 255 or _is_kept(code.co_code, number)):
            yield from lengths


def _is_kept(steps: bytes, number: int) -> bool:
    """Whether a tuple among the constants is used other than as an index or taken apart."""
    load = bytes((_LOAD_CONSTANT, number))
    at = steps.find(load)
    while at >= 0:
        if at % 2 == 0 and steps[at + 2] not in _TAKES_APART and steps[at + 2 : at + 4] not in _ADDS_TO_ELEMENT:
            return True
        at = steps.find(load, at + 1)
    return False


def contents(cell: CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # not assigned yet
        return MISSING


def is_numba_type(value: Any) -> bool:
    """Tell whether something is a type of Numba's; ``isinstance`` is slow there, for classes with many subclasses."""
    return types.Type in type(value).__mro__


def module_of(thing: Any) -> str:
    return str(getattr(thing, "__module__", None) or type(thing).__module__)


def top(module: str) -> str:
    return module.partition(".")[0]


@cache
def is_versioned(module: str) -> bool:
    """Whether a module's version stands for its content: it is Python's, NumPy's or Numba's."""
    name = top(module)
    if name in _VERSIONED or name in sys.builtin_module_names:
        return True
    if name not in sys.stdlib_module_names:
        return False
    loaded = sys.modules.get(name)
    spec = getattr(loaded, "__spec__", None) if loaded is not None else importlib.util.find_spec(name)
    origin = str(getattr(spec, "origin", None))  # a user's file may have such a name
    return origin in ("built-in", "frozen") or (origin.startswith(_STANDARD_LIBRARY) and "-packages" not in origin)


# --------------------------------------------------------------------------------------------------------- Overloads

#: Templates of the functions registered for an object, by its id; those of Numba itself are not among them.
_overloads: dict[int, list[type]] = {}
_registered = 0


def find_overloads() -> bool:
    """Look for newly registered overloads; return whether there are any."""
    global _registered
    entries = builtin_registry.globals[_registered:]
    _registered += len(entries)
    found = False
    for value, kind in entries:
        for template in getattr(kind, "templates", ()):
            function = getattr(template, "_overload_func", None)
            if function is not None and not all(is_versioned(module_of(thing)) for thing in (value, function)):
                _overloads.setdefault(id(value), []).append(template)
                found = True
    return found
