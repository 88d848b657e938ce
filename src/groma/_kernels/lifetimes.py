# SPDX-License-Identifier: BSD-3-Clause
"""Where Numba's compiler uses variables for the last time, found out when it is asked for.

Numba finds it anew after each of nine steps, though three of them ask: a tenth of the time that Python takes of a
compilation. Here it is found when it is read, and the variables of a statement are listed with fewer calls.

In come classes of Numba's compiler; out comes ``on_demand``, inside which they do so.
"""

from __future__ import annotations

import dis
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import analysis, interpreter, ir, transforms
from numba.core.interpreter import Interpreter
from numba.core.postproc import PostProcessor, VariableLifetime

#: What refers to no variable.
_PLAIN = frozenset((str, int, float, bool, type(None), ir.Loc, ir.Const, ir.Global, ir.FreeVar, ir.Arg))
#: Blocks of ``with`` may be compiled in another way, which reads more.
_WITH: Any = dis.opmap.get("BEFORE_WITH", dis.opmap.get("LOAD_SPECIAL"))
#: What two of the steps after the translation of bytecode look for: such blocks, and joined dictionaries.
_LOOKED_FOR = frozenset((_WITH, dis.opmap["DICT_UPDATE"]))
_process, _list_variables, _uses_and_definitions = PostProcessor.run, ir.Inst._rec_list_vars, analysis.compute_use_defs
_post_process = Interpreter.post_process
_LOOKING = (interpreter.peep_hole_delete_with_exit, interpreter.peep_hole_fuse_dict_add_updates)


def _process_on_demand(self: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
    """Take the place of :meth:`PostProcessor.run`."""
    function = self.func_ir
    if function.is_generator or _WITH in function.func_id.code.co_code[::2]:
        _process(self, emit_dels, extend_lifetimes)
        return
    function.blocks = transforms.canonicalize_cfg(function.blocks)
    function.variable_lifetime = VariableLifetime(function.blocks)
    function.generator_info = None
    if emit_dels:
        self._insert_var_dels(extend_lifetimes=extend_lifetimes)


def _post_process_on_demand(self: Any, peepholes: Any, func_ir: Any) -> Any:
    """Take the place of :meth:`Interpreter.post_process`: leave out steps that look for what is not there."""
    if _LOOKED_FOR.isdisjoint(func_ir.func_id.code.co_code[::2]):
        peepholes = [step for step in peepholes if step not in _LOOKING]
    return _post_process(self, peepholes, func_ir)


def _variables(self: Any, val: Any) -> list[Any]:
    """Take the place of :meth:`ir.Inst._rec_list_vars`: the variables in a value, in their order."""
    kind = type(val)
    if kind is not dict and kind is not tuple and kind is not list:
        return _list_variables(self, val)
    found = []
    for item in val.values() if kind is dict else val:
        kind = type(item)
        if kind is ir.Var:
            found.append(item)
        elif kind not in _PLAIN:
            found.extend(self._rec_list_vars(item))
    return found


def _uses(blocks: Any) -> Any:
    """Take the place of :func:`analysis.compute_use_defs`: names that each block uses before it defines them."""
    used: dict[int, set[str]] = {}
    defined: dict[int, set[str]] = {}
    for offset, block in blocks.items():
        uses = used[offset] = set()
        definitions = defined[offset] = set()
        for statement in block.body:
            if type(statement) in analysis.ir_extension_usedefs:
                return _uses_and_definitions(blocks)
            if type(statement) is not ir.Assign:
                uses.update(_names(statement) - definitions)
                continue
            value, target = statement.value, statement.target.name
            names = {value.name} if type(value) is ir.Var else _names(value) if isinstance(value, ir.Inst) else set()
            if target not in names:
                definitions.add(target)
            uses.update(names - definitions)
    return analysis._use_defs_result(usemap=used, defmap=defined)


def _names(statement: Any) -> set[str]:
    return {variable.name for variable in statement.list_vars()}


@contextmanager
def on_demand() -> Iterator[None]:
    """Let Numba find uses when it needs them; for a thread that holds the lock of the compiler."""
    before = PostProcessor.run, ir.Inst._rec_list_vars, analysis.compute_use_defs
    PostProcessor.run, ir.Inst._rec_list_vars, analysis.compute_use_defs = _process_on_demand, _variables, _uses
    Interpreter.post_process = _post_process_on_demand
    try:
        yield
    finally:
        PostProcessor.run, ir.Inst._rec_list_vars, analysis.compute_use_defs = before
        Interpreter.post_process = _post_process
