# SPDX-License-Identifier: BSD-3-Clause
"""The decorators for compiled code. Nothing else in groma calls ``numba.njit``.

``@kernel`` marks scalar code on one item: floats and small arrays in, results written to a passed-in array. It is
always inlined into the loops that call it.
``@loop`` marks the walk over a batch that calls a kernel by its module-level name. LLVM neither vectorises nor unrolls
it, which most of ours do not repay; ``@unrolled_loop`` is for those that do: measure it.

Both release the GIL and are cached on disk by :mod:`groma._kernels.cache`. Division by zero gives inf or NaN, as in
NumPy. Reassociation and fused multiply-add are allowed; NaN and infinity keep their meaning.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit

from groma._kernels.cache import keep_on_disk
from groma._kernels.inner import ARITHMETIC, Pipeline, UnrollingPipeline

_OPTIONS = {
    "pipeline_class": Pipeline,
    "nogil": True,
    "no_cfunc_wrapper": True,  # for callers in C, of which there are none
    **ARITHMETIC,
}


def _compiled(**options: Any) -> Callable[[Callable], Any]:
    def decorate(function: Callable) -> Any:
        return keep_on_disk(njit(**{**_OPTIONS, **options})(function))

    return decorate


kernel = _compiled(forceinline=True)
#: A kernel whose operations are done as written: its result is the same whatever loop it is inlined into.
exact_kernel = _compiled(forceinline=True, fastmath=False)
#: A step of a long loop, pasted into it before anything is optimised: compiled as if it were written there.
inline_kernel = _compiled(inline="always")
loop = _compiled()
#: A loop around short ones of fixed length, which LLVM writes out and vectorises: longer to compile.
unrolled_loop = _compiled(pipeline_class=UnrollingPipeline)
