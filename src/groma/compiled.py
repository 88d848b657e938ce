# SPDX-License-Identifier: BSD-3-Clause
"""The decorators for compiled code of your own: kernels of a camera model or a loss, loops of a factor.

``kernel`` marks scalar code on one item, which is inlined into the loops that call it; ``loop`` marks the walk over a
batch, which calls kernels by their module-level names. ``unrolled_loop`` is one whose inner loops LLVM vectorises and
unrolls, for twice the time to compile. All are kept on disk like those of groma itself.
"""

from groma._numba import kernel, loop, unrolled_loop

__all__ = ["kernel", "loop", "unrolled_loop"]
