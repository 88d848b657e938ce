# SPDX-License-Identifier: BSD-3-Clause
"""Functions that only other compiled functions call are compiled for linking, and no further.

Numba gives each function machine code and a wrapper that Python calls. A kernel is inlined into the machine code of its
callers, so both are thrown away. Here a function that is compiled inside another one ends as LLVM's code, simplified
and no more: it is optimised as part of what it is inlined into. If Python calls such a function later, it is compiled
once more, in full. What Python calls is simplified after inlining only. Wrappers are not optimised: a call takes 20
nanoseconds more, of half a microsecond, and compiling a seventh less. Numba's own functions that ours call, such as
``np.empty``, are compiled in the same way, and kept.

What comes out depends on sources alone, not on what was compiled before, by this process or others: of a function that
Python has called, too, the form for linking is linked, and names are digests.

In come the pipeline and the libraries of Numba's compiler; out comes ``Pipeline``, which ``numba.njit`` is told to use.
A version of Numba that is not known here compiles in its own way, every function in full.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import llvmlite.binding as llvm
import numba
from numba.core import config
from numba.core.bytecode import FunctionIdentity
from numba.core.caching import CompileResultCacheImpl
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult, Flags
from numba.core.compiler_lock import global_compiler_lock
from numba.core.compiler_machinery import PassManager
from numba.core.cpu_options import FastMathOptions
from numba.core.sigutils import normalize_signature
from numba.core.targetconfig import ConfigStack
from numba.core.typed_passes import NativeLowering as NumbaLowering
from numba.core.typed_passes import NopythonRewrites as NumbaRewrites
from numba.core.typed_passes import NopythonTypeInference
from numba.core.types import unliteral
from numba.core.typing.templates import _OverloadFunctionTemplate
from numba.core.untyped_passes import InlineClosureLikes as NumbaInlineClosureLikes

from groma._kernels.digest import dependence
from groma._kernels.elements import NativeLowering
from groma._kernels.lifetimes import on_demand
from groma._kernels.loading import rebuilt
from groma._kernels.parts import is_versioned, module_of
from groma._kernels.rewrites import InlineClosureLikes, NopythonRewrites
from groma._kernels.shortcuts import TypeInference, remembering

#: Whether the insides of Numba are those that the tests have seen.
is_known = (0, 66) <= tuple(map(int, numba.__version__.split(".")[:2])) < (0, 69)
#: Steps of Numba's compiler, and what takes their place.
OURS = {
    NumbaLowering: NativeLowering,
    NopythonTypeInference: TypeInference,
    NumbaInlineClosureLikes: InlineClosureLikes,
    NumbaRewrites: NopythonRewrites,
}


class _InOrder(set[str]):
    """A set whose text is the same in every process: Numba writes it into the names of functions."""

    def copy(self) -> _InOrder:
        return self

    def __repr__(self) -> str:
        return repr(sorted(self))


#: What operations mean: division by zero, and which of them may be exchanged.
ARITHMETIC = {"error_model": "numpy", "fastmath": _InOrder(("contract", "reassoc", "nsz", "arcp"))}
#: How the names of wrappers begin.
_WRAPPER = "_ZN7cpython"
#: How many functions are being compiled: one inside the other. Numba compiles in one thread at a time.
_depth = 0


def is_inside() -> bool:
    """Whether a function is being compiled, so that what is asked for is for linking."""
    return _depth > 0


@contextmanager
def one_deeper() -> Iterator[None]:
    """Compile a function."""
    global _depth
    _depth += 1
    try:
        yield
    finally:
        _depth -= 1


class _NoMachineCode:
    """Stands where the function that Python calls would be; Numba finds what to link by it."""


class _Library(JITCodeLibrary):
    """Code of a function that Python calls; the wrapper, which unpacks arguments, is not optimised.

    What it calls is linked in, and is its own. Otherwise, of all libraries with a function of the same name, each
    optimised in its own way, the one that is loaded first would give its code to the others, and the last digits of
    results would hang on the order of loading.
    """

    #: Whether what was linked in is of no use to other libraries.
    _owns = True
    #: Whether loops are vectorised and unrolled: a third more work for LLVM, which few of ours repay.
    is_unrolled = False

    def _optimize_functions(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout
        for function in ll_module.functions:
            if function.is_declaration:
                continue
            if function.name.startswith(_WRAPPER):
                function.add_function_attribute("noinline")
                function.add_function_attribute("optnone")
                continue
            passes, builder = self._first_passes()
            passes.run(function, builder)

    def _first_passes(self) -> tuple[Any, Any]:
        """Return what is done before anything is inlined: what more there is has to be done again afterwards."""
        passes = llvm.create_new_function_pass_manager()
        passes.add_sroa_pass()
        passes.add_simplify_cfg_pass()
        return passes, self._codegen._pass_builder()

    def _optimize_final_module(self) -> None:
        for function in self._final_module.functions if self._owns else ():
            if function.linkage == llvm.Linkage.linkonce_odr:
                function.linkage = llvm.Linkage.internal
        if self.is_unrolled:
            super()._optimize_final_module()
            return
        self._simplify()
        tuning = llvm.create_pipeline_tuning_options(config.OPT)  # type: ignore[attr-defined]
        tuning.loop_vectorization = tuning.slp_vectorization = tuning.loop_unrolling = False
        builder = llvm.create_pass_builder(self._codegen._tm, tuning)
        passes = builder.getModulePassManager()
        passes.add_refprune_pass()
        passes.run(self._final_module, builder)

    def _simplify(self) -> None:
        """Inline, turn loops round and simplify."""
        passes, builder = self._codegen._module_pass_manager(
            loop_vectorize=False, slp_vectorize=False, opt=0, cost="cheap"
        )
        passes.run(self._final_module, builder)


class _InnerLibrary(_Library):
    """Code of a function that is linked into others."""

    _owns = False

    def _first_passes(self) -> tuple[Any, Any]:
        return self._codegen._function_pass_manager()

    def _optimize_final_module(self) -> None:
        """Simplify; the rest is done once, in the function that this becomes part of."""
        self._simplify()

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True

    def serialize_using_object_code(self) -> Any:
        self._ensure_finalized()
        return self.name, "bitcode", self._get_module_for_linking().as_bitcode()

    @classmethod
    def read(cls, codegen: Any, name: str, content: bytes) -> _InnerLibrary:
        """Return what was serialised."""
        library = cls(codegen, name)
        library._final_module = library._shared_module = llvm.parse_bitcode(content)
        library._finalized = True
        return library


class _Steps(PassManager):
    """Numba's steps of compiling, without the events, descriptions and clocks around each, a twentieth of the time."""

    def _runPass(self, index: int, pss: Any, internal_state: Any) -> None:  # type: ignore[override]  # noqa: N802
        pss.analysis = self._analysis
        for run in (pss.run_initialization, pss.run_pass, pss.run_finalizer):
            run(internal_state)


class Pipeline(Compiler):
    """Numba's compiler, which goes less far for functions inside others."""

    is_unrolled = False

    def define_pipelines(self) -> Any:
        if not is_known:
            return super().define_pipelines()
        state: Any = self.state
        if state.library is None:
            kind = _InnerLibrary if _depth > 1 else _Library
            state.library = kind(state.targetctx.codegen(), state.func_id.func_qualname)
            state.library.is_unrolled = self.is_unrolled
            state.library.enable_object_caching()
            if kind is _Library:  # of two equal functions, each is called by its own name
                state.func_id.unique_id = next(FunctionIdentity._unique_ids)
            else:
                state.flags.no_compile = state.flags.no_cpython_wrapper = state.flags.no_cfunc_wrapper = True
        pipelines = super().define_pipelines()
        return [_ours(pipeline) for pipeline in pipelines]


class UnrollingPipeline(Pipeline):
    """The same, which vectorises and unrolls loops."""

    is_unrolled = True


def _ours(steps: PassManager) -> PassManager:
    """Return the same steps, some of them ours."""
    ours = _Steps(steps.pipeline_name)
    for step, said in steps.passes:
        ours.add_pass(OURS.get(step, step), said)
    ours.finalize()
    return ours


def completed(result: Any) -> Any:
    """Let what was compiled be found, by callers that are being compiled or by Python."""
    if isinstance(result.library, _InnerLibrary):
        result = result._replace(entry_point=_NoMachineCode())
        result.target_context.insert_user_function(result.entry_point, result.fndesc, [result.library])
    else:  # inlined functions may refer to objects by tables of theirs, which this code has copies of
        for environment in result._find_referenced_environments():
            result.library.codegen.set_env(environment.env_name, environment)
    return result


class Results(CompileResultCacheImpl):
    """How compiled functions are written to disk and read again."""

    def reduce(self, cres: Any) -> Any:
        return super().reduce(cres._replace(type_annotation=""))  # a listing that nobody reads

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        (name, kind, content), fndesc, environment, signature, *rest = payload
        if kind != "bitcode":
            return rebuilt(target_context, payload)
        objectmode, lifted, annotation, reload_init, _ = rest
        for initialise in reload_init:
            initialise()
        return CompileResult(
            target_context=target_context,
            typing_context=target_context.typing_context,
            library=_InnerLibrary.read(target_context.codegen(), name, content),
            environment=environment,
            entry_point=_NoMachineCode(),
            fndesc=fndesc,
            type_annotation=annotation,
            signature=signature,
            objectmode=objectmode,
            lifted=lifted,
            typing_error=None,
            call_helper=None,
            metadata=None,
            reload_init=reload_init,
            referenced_envs=rest[-1],
        )


@cache
def _inherited() -> Flags:
    """Return what Numba's functions take over from their caller, here the same for all callers: they are kept once."""
    flags: Any = Flags()
    flags.nrt, flags.forceinline = True, False
    flags.error_model, flags.fastmath = ARITHMETIC["error_model"], FastMathOptions(ARITHMETIC["fastmath"])
    return flags


def tell_apart(dispatcher: Any, keep: Callable[[Any], Any]) -> None:
    """Keep what has no machine code from Python, which gets it compiled in full; ``keep`` is for Numba's functions."""
    kind = type(dispatcher)
    linked: dict[tuple, Any] = {}
    is_ours = not is_versioned(module_of(dispatcher.py_func))

    def compile_for_caller(signature: Any) -> Any:
        with global_compiler_lock:
            if not is_known:
                return kind.compile(dispatcher, signature)
            arguments = tuple(normalize_signature(signature)[0])
            if _depth and is_ours:  # one for ``f(x, 0)`` and ``f(x, 1)``
                signature = arguments = tuple(map(unliteral, arguments))
            found = dispatcher.overloads.get(arguments)
            if not _depth:
                if found is not None and isinstance(found.entry_point, _NoMachineCode):
                    del dispatcher.overloads[arguments]
                with on_demand(), remembering(), _keeping_overloads(keep):
                    return kind.compile(dispatcher, signature)
            if arguments in linked:
                return linked[arguments].entry_point
            dispatcher.overloads.pop(arguments, None)
            try:
                with ConfigStack().enter(_inherited()):
                    return kind.compile(dispatcher, signature)
            finally:
                if found is not None:
                    dispatcher.overloads[arguments] = found

    def add_overload(result: Any) -> None:
        arguments = tuple(result.signature.args)
        if isinstance(result.entry_point, _NoMachineCode):
            dispatcher.overloads[arguments] = linked[arguments] = result
        else:
            kind.add_overload(dispatcher, result)

    def get_overload(signature: Any) -> Any:
        found = linked.get(tuple(normalize_signature(signature)[0])) if _depth else None
        return kind.get_overload(dispatcher, signature) if found is None else found.entry_point

    dispatcher.compile = compile_for_caller
    dispatcher.add_overload = add_overload
    dispatcher.get_overload = get_overload


_decorator = _OverloadFunctionTemplate._get_jit_decorator
_identity: Any = FunctionIdentity.from_function.__func__


@contextmanager
def _keeping_overloads(keep: Callable[[Any], Any]) -> Iterator[None]:
    """Compile Numba's own functions for linking, and keep them; for a thread that holds the lock of the compiler.

    What is linked gets names that are the same in all processes. Numba counts, so that a function that comes into a
    loop by way of two others would be there twice if two processes had kept them, and last digits would hang on it.
    """

    def find_decorator(self: Any) -> Any:
        decorator = _decorator(self)
        return lambda **options: lambda made: keep(decorator(**{"pipeline_class": Pipeline, **options})(made))

    def identify(kind: Any, function: Any) -> Any:
        identity = _identity(kind, function)
        identity.unique_id = dependence(function, ()).content[:16]
        identity.unique_name = f"{identity.func_qualname}${identity.unique_id}"
        return identity

    templates: Any = _OverloadFunctionTemplate
    identities: Any = FunctionIdentity
    templates._get_jit_decorator, identities.from_function = find_decorator, classmethod(identify)
    try:
        yield
    finally:
        templates._get_jit_decorator, identities.from_function = _decorator, classmethod(_identity)
