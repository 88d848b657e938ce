# SPDX-License-Identifier: BSD-3-Clause
"""The two decorators for compiled code. Nothing else in groma calls ``numba.njit``.

``@kernel`` marks scalar code on one item: floats and small arrays in, results written to a passed-in array.
``@loop`` marks the walk over a batch that calls a kernel by its module-level name.

Both release the GIL and are cached on disk. Division by zero gives inf or NaN, as in NumPy. Reassociation and
fused multiply-add are allowed; NaN and infinity keep their meaning.
"""

from numba import njit

_OPTIONS = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "reassoc", "nsz", "arcp"},
}

kernel = njit(forceinline=True, **_OPTIONS)
loop = njit(**_OPTIONS)
