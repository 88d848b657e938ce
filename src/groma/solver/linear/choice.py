# SPDX-License-Identifier: BSD-3-Clause
"""Which solver of the reduced system is used: the one that is named, or the one that expects to be fastest.

``dense``
    Cholesky (LAPACK). Best for small systems.
``sparse``
    Direct factorisation with a fill-reducing symmetric ordering. Best for graphs of poses.
``pcg``
    Preconditioned conjugate gradients. Best for large systems.

Others are added with :func:`groma.solver.linear.contract.register_linear_solver`.
"""

from __future__ import annotations

from groma.errors import InputError, did_you_mean
from groma.problem.layout import Layout
from groma.solver.linear import dense, pcg, sparse  # noqa: F401  they register themselves
from groma.solver.linear.contract import LinearSolver, registered_linear_solvers


def linear_solver_names() -> tuple[str, ...]:
    """Return the names of linear solvers, ``auto`` first."""
    return ("auto", *registered_linear_solvers())


def linear_solver(layout: Layout, name: str) -> LinearSolver:
    """Return the solver of a name; for ``auto`` the one that expects to be fastest."""
    known = registered_linear_solvers()
    if name == "auto":
        return min((make(layout) for make in known.values()), key=lambda solver: solver.expected_seconds())
    if name not in known:
        raise InputError(
            f"linear_solver must be one of {', '.join(linear_solver_names())}; got {name!r}."
            + did_you_mean(name, linear_solver_names())
        )
    return known[name](layout)
