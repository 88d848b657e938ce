# SPDX-License-Identifier: BSD-3-Clause
"""The loops around a user's function: written for its slots, compiled with it.

A loop that gets its kernel as an argument, or closes over it, cannot be typed for a changing number of variables. So
the source of the two loops is written out for each user factor, as one would by hand. It counts as part of the file of
the user's function, beside which it is kept once it is compiled.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numba
import numpy as np

from groma._numba import kernel, loop
from groma.errors import InputError
from groma.factors._record import put_block, put_residual
from groma.factors.contract import Slot
from groma.geometry.manifold import FACTOR_COLUMNS

_CENTRAL_STEP = float(np.finfo(float).eps ** (1 / 3))
_COMPLEX_STEP = 1e-30


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _load_pose(flat, pose):
    for i in range(3):
        for j in range(4):
            pose[i, j] = flat[4 * i + j]


@kernel
def _load_vector(flat, vector):
    for i in range(vector.shape[0]):
        vector[i] = flat[i]


@kernel
def _move_pose(flat, k, h, pose):
    """Write (I + h G_k) T: translation along axis k < 3, or rotation about axis k - 3; return the size of the step."""
    _load_pose(flat, pose)
    if k < 3:  # derived from the order of a twist: translation first
        step = h * max(1.0, abs(flat[4 * k + 3]))
        pose[k, 3] += step
        return step
    i, j = (k - 2) % 3, (k - 1) % 3
    for c in range(4):
        pose[i, c] -= h * flat[4 * j + c]
        pose[j, c] += h * flat[4 * i + c]
    return h


@kernel
def _move_vector(flat, k, h, vector):
    """Write the vector with ``h`` times its size added to entry k; return the size of the step."""
    _load_vector(flat, vector)
    step = h * max(1.0, abs(flat[k]))
    vector[k] += step
    return step


@kernel
def _put_difference(up, down, h, J, k):
    for i in range(up.shape[0]):
        J[i, k] = (up[i] - down[i]) / h


@kernel
def _put_imaginary(up, h, J, k):
    for i in range(up.shape[0]):
        J[i, k] = up[i].imag / h


@kernel
def _is_finite(r):
    for i in range(r.shape[0]):
        if not np.isfinite(r[i]):
            return False
    return True


@kernel
def _block_is_finite(J):
    for i in range(J.shape[0]):
        if not _is_finite(J[i]):
            return False
    return True


# -------------------------------------------------------------------------------------------------------------- Loops
def _write_loops(slots: Sequence[Slot], sizes: Sequence[int], residual_size: int, derivative: str) -> str:
    """Return the source of ``residuals_all`` and ``linearize_all`` for these slots."""
    numbers = range(len(slots))
    is_pose = [slot.kind == "pose" for slot in slots]
    groups = ", ".join(f"g{b}, i{b}" for b in numbers)
    arguments = ", ".join(f"x{b}" for b in numbers)
    scalar = "np.complex128" if derivative == "complex" else "np.float64"

    def buffers(prefix: str, dtype: str) -> list[str]:
        shapes = ["(3, 4)" if is_pose[b] else str(sizes[b]) for b in numbers]
        return [f"    {prefix}{b} = np.empty({shapes[b]}, {dtype})" for b in numbers]

    def load(prefix: str, b: int) -> str:
        return f"_load_{'pose' if is_pose[b] else 'vector'}(g{b}[i{b}[f]], {prefix}{b})"

    lines = [f"def residuals_all(data, {groups}, begin, end, out):", *buffers("x", "np.float64")]
    lines += ["    degenerate = 0", "    for f in range(begin, end):"]
    lines += [f"        {load('x', b)}" for b in numbers]
    lines += [
        "        r = out[f - begin]",
        "        r[:] = np.nan",
        f"        residual(data[f], {arguments}, r)",
        "        if not _is_finite(r):",
        "            r[:] = 0.0",
        "            degenerate += 1",
        "    return degenerate",
        "",
        f"def linearize_all(data, {groups}, begin, end, columns, record):",
        f"    m = {residual_size}",
        *buffers("x", "np.float64"),
        "    r = np.empty(m)",
    ]
    columns = [FACTOR_COLUMNS.get(slot.kind, size) for slot, size in zip(slots, sizes, strict=True)]
    lines += [f"    J{b} = np.empty((m, {columns[b]}))" for b in numbers]
    if derivative != "given":
        lines += [*buffers("z", scalar), f"    up, down = np.empty(m, {scalar}), np.empty(m, {scalar})"]
    lines += ["    degenerate = 0", "    for f in range(begin, end):"]
    lines += [f"        {load('x', b)}" for b in numbers]
    lines += ["        r[:] = np.nan", f"        residual(data[f], {arguments}, r)", "        valid = _is_finite(r)"]
    if derivative == "given":
        lines += [f"        {load('x', b)}" for b in numbers]
        blocks = ", ".join(f"J{b}" for b in numbers)
        lines += [f"        J{b}[:] = 0.0" for b in numbers]
        lines += ["        if valid:", f"            jacobian(data[f], {arguments}, {blocks})"]
    else:
        moved = ", ".join(f"z{b}" for b in numbers)
        reload = [f"                {load('z', b)}" for b in numbers]
        for b in numbers:
            move = f"_move_{'pose' if is_pose[b] else 'vector'}(g{b}[i{b}[f]], k, "
            lines += [f"        if valid and columns[{b}] >= 0:", f"            for k in range({columns[b]}):", *reload]
            if derivative == "complex":
                lines += [
                    f"                h = {move}{_COMPLEX_STEP!r}j, z{b})",
                    f"                residual(data[f], {moved}, up)",
                    f"                _put_imaginary(up, h.imag, J{b}, k)",
                ]
            else:
                lines += [
                    f"                h = {move}{_CENTRAL_STEP!r}, z{b})",
                    f"                residual(data[f], {moved}, up)",
                    *reload,
                    f"                {move}{-_CENTRAL_STEP!r}, z{b})",
                    f"                residual(data[f], {moved}, down)",
                    f"                _put_difference(up, down, 2.0 * h, J{b}, k)",
                ]
    for b in numbers:
        lines += [
            f"        if valid and columns[{b}] >= 0 and not _block_is_finite(J{b}):",
            "            valid = False",
        ]
    lines += ["        if not valid:", "            r[:] = 0.0", "            degenerate += 1"]
    for b in numbers:
        lines += [
            f"        if columns[{b}] >= 0:",
            "            if not valid:",
            f"                J{b}[:] = 0.0",
            f"            put_block(J{b}, record[f - begin], columns[{b}])",
        ]
    lines += ["        put_residual(r, record[f - begin])", "    return degenerate"]
    return "\n".join(lines)


@dataclass(eq=False)
class Loops:
    """The two loops of one user factor, compiled when first needed."""

    name: str
    #: The user's functions of the residual and, for the derivative ``jacobian``, of its blocks.
    function: Callable
    jacobian: Callable | None
    #: ``central``, ``complex`` or ``jacobian``.
    derivative: str
    slots: Sequence[Slot]
    #: Numbers of each slot's variable that the function gets.
    sizes: Sequence[int]
    residual_size: int
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _compiled: tuple[Callable, Callable] | None = None

    def get(self) -> tuple[Callable, Callable]:
        """Return (residuals_all, linearize_all)."""
        with self._lock:
            if self._compiled is None:
                self._compiled = self._compile()
        return self._compiled

    def _compile(self) -> tuple[Callable, Callable]:
        real = [numba.float64[:, ::1] if slot.kind == "pose" else numba.float64[::1] for slot in self.slots]
        signatures = [(numba.float64[::1], *real, numba.float64[::1])]
        if self.derivative == "complex":
            vary = [numba.complex128[:, ::1] if slot.kind == "pose" else numba.complex128[::1] for slot in self.slots]
            signatures.append((numba.float64[::1], *vary, numba.complex128[::1]))
        names: dict[str, Any] = {
            "np": np,
            "__name__": self.function.__module__,
            "residual": self._compile_function(self.function, "residual", signatures),
            "put_block": put_block,
            "put_residual": put_residual,
        }
        helpers = (
            _load_pose, _load_vector, _move_pose, _move_vector, _put_difference, _put_imaginary, _is_finite,
            _block_is_finite,
        )  # fmt: skip
        names.update({helper.__name__: helper for helper in helpers})
        if self.jacobian is not None:
            signature = (numba.float64[::1], *real, *[numba.float64[:, ::1]] * len(real))
            names["jacobian"] = self._compile_function(self.jacobian, "jacobian", [signature])
        source = _write_loops(self.slots, self.sizes, self.residual_size, self.derivative)
        plain: Any = getattr(self.function, "py_func", self.function)
        exec(compile(source, plain.__code__.co_filename, "exec"), names)
        made = names["residuals_all"], names["linearize_all"]
        for function in made:
            function.__qualname__ = f"{plain.__qualname__}.{function.__name__}"  # its file is named after it
        return loop(made[0]), loop(made[1])

    def _compile_function(self, function: Callable, role: str, signatures: Sequence[tuple]) -> Callable:
        compiled: Any = function if hasattr(function, "py_func") else loop(function)
        if not hasattr(compiled, "compile"):  # NUMBA_DISABLE_JIT=1
            return compiled
        for signature in signatures:
            try:
                compiled.compile(signature)
            except Exception as error:  # Numba has no common root for them
                complex_hint = ""
                if self.derivative == "complex" and signature[-1].dtype == numba.complex128:
                    complex_hint = (
                        "With derivative='complex' it must also accept complex numbers; use derivative='central' if it "
                        "cannot. "
                    )
                reason = "\n".join(line for line in str(error).splitlines() if line.strip())
                raise InputError(
                    f"The {role} function of factor {self.name!r} must be of the kind that Numba compiles. It was not, "
                    f"for arguments of the types ({', '.join(map(str, signature))}). {complex_hint}Use numbers, tuples "
                    f"and NumPy arrays only. Numba says:\n{reason}"
                ) from error
        return compiled
