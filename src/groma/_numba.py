# SPDX-License-Identifier: BSD-3-Clause
"""The two decorators for compiled code. Nothing else in groma calls ``numba.njit``.

``@kernel`` marks scalar code on one item: floats and small arrays in, results written to a passed-in array. It is
always inlined into the loops that call it.
``@loop`` marks the walk over a batch that calls a kernel by its module-level name.

Both release the GIL and are cached on disk. Division by zero gives inf or NaN, as in NumPy. Reassociation and
fused multiply-add are allowed; NaN and infinity keep their meaning.

Numba's cache compares the file of a function with the one it was compiled from, but not the files of the kernels it
calls. Here every cached function is stamped with all files that hold compiled code, so that a change in one of them,
by an edit or by an upgrade, never brings back old numbers.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

from numba import njit

_OPTIONS = {
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "reassoc", "nsz", "arcp"},
}
#: A file that contains one of these holds compiled code, or chooses it.
_MARKS = (b"_numba import", b"numba.extending", b"llvmlite")


@lru_cache(maxsize=1)
def _stamp() -> str:
    """Return a digest of all files of the package that hold compiled code."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        content = path.read_bytes()
        if any(mark in content for mark in _MARKS):
            digest.update(path.name.encode() + b"\0" + content)
    return digest.hexdigest()


def _compiled(**options: Any) -> Callable[[Callable], Any]:
    def decorate(function: Callable) -> Any:
        dispatcher = njit(cache=True, **_OPTIONS, **options)(function)
        cache_file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
        if cache_file is not None:  # absent without the compiler
            cache_file._source_stamp = _stamp()
        return dispatcher

    return decorate


kernel = _compiled(forceinline=True)
loop = _compiled()


def uncached(function: Callable) -> Any:
    """Compile a function that has no file of its own, such as the loops made for a user's factor."""
    return njit(**_OPTIONS)(function)
