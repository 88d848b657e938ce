# SPDX-License-Identifier: BSD-3-Clause
"""Compiled code from disk, ready to be called.

A file holds machine code and, for functions that call this one and are yet to be compiled, the code before that. Numba
parses the second at once, half of the time of loading and most of the memory. Here it is parsed when a function is
compiled that needs it.
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult


class _Library(JITCodeLibrary):
    """One whose code for others to link is parsed when it is asked for."""

    _parsed: Any = None
    _unparsed: bytes | None = None

    @property
    def _shared_module(self) -> Any:
        if self._parsed is None and self._unparsed is not None:
            self._parsed, self._unparsed = llvm.parse_bitcode(self._unparsed), None
            self._codegen._engine._load_defined_symbols(self._parsed)
        return self._parsed

    @_shared_module.setter
    def _shared_module(self, module: Any) -> None:
        self._parsed = module

    def get_pointer_to_function(self, name: str) -> int:
        """Return where a function lies; 0 if it is not here."""
        if not self._codegen._engine.is_symbol_defined(name):
            _ = self._shared_module  # names what is here
        return super().get_pointer_to_function(name)

    @classmethod
    def loaded(cls, codegen: Any, state: tuple[str, str, tuple[bytes, bytes]]) -> JITCodeLibrary:
        """Return the library of what :meth:`serialize_using_object_code` made."""
        name, _, (machine_code, unparsed) = state
        library = cls(codegen, name)
        library.enable_object_caching()
        library._set_compiled_object(machine_code)
        library._unparsed = unparsed
        library._finalize_final_module()
        return library


class _Codegen:
    """Numba's, which loads libraries as above."""

    def __init__(self, codegen: Any) -> None:
        self._codegen = codegen

    def unserialize_library(self, state: tuple[str, str, tuple[bytes, bytes]]) -> JITCodeLibrary:
        return _Library.loaded(self._codegen, state)


class _Context:
    """Numba's target, with that."""

    def __init__(self, context: Any) -> None:
        self._context = context

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)

    def codegen(self) -> _Codegen:
        return _Codegen(self._context.codegen())


def rebuilt(context: Any, reduced: tuple) -> CompileResult:
    """Return a compiled function from what :class:`CompileResult` reduced it to."""
    entry = reduced[1].llvm_cpython_wrapper_name
    context.codegen()._engine._defined_symbols.add(entry)  # it is there, or there were nothing to call
    return CompileResult._rebuild(_Context(context), *reduced)._replace(target_context=context)
