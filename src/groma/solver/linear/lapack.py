# SPDX-License-Identifier: BSD-3-Clause
"""LAPACK's Cholesky factorisation and triangular solves, in double precision.

``scipy.linalg`` has them; importing all of it takes a quarter of a second, ten times as long as the module of LAPACK in
it, which is looked up here by itself. Where SciPy keeps it elsewhere, the whole is imported.

``potrf``, ``potrs`` and ``potri`` are LAPACK's (see :mod:`scipy.linalg.lapack`); the factors are in Fortran order.
"""

from __future__ import annotations

import sys
from importlib.machinery import PathFinder
from importlib.util import module_from_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import scipy

from groma._typing import FloatArray

_NAME = "scipy.linalg._flapack"


def _module() -> ModuleType:
    known = sys.modules.get(_NAME)
    if known is not None:
        return known
    spec = PathFinder.find_spec(_NAME, [str(Path(scipy.__file__).parent / "linalg")])
    if spec is None or spec.loader is None:
        from scipy.linalg import lapack

        return lapack
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    # scipy.linalg, imported later, takes this one
    return sys.modules.setdefault(_NAME, module)


_lapack: Any = _module()
potrf, potrs, potri = _lapack.dpotrf, _lapack.dpotrs, _lapack.dpotri


def solve_lower(L: FloatArray, rhs: FloatArray, transposed: bool = False) -> FloatArray:
    """Return L^-1 ``rhs``, or L^-T ``rhs``, for a lower triangle L of :func:`potrf`."""
    return _lapack.dtrtrs(L, rhs, lower=1, trans=int(transposed))[0]
