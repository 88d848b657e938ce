# SPDX-License-Identifier: BSD-3-Clause
"""Compiled code on a CUDA device, from the same source as on the processor.

Kernels (see :mod:`groma._numba`) are scalar code without allocation, so they are device functions as they stand.
:func:`device_loop` takes a loop with one thread per item, and turns it and every kernel that it calls, directly or not;
names that stand for a choice at compile time, such as the projection of a camera model, are filled in on the way. No
formula is written twice: :mod:`groma.factors._on_device` holds loops that fill the same records as those for the
processor, from the same kernels.

Needs the package ``numba-cuda`` and a device, or, for tests, Numba's simulator (``NUMBA_ENABLE_CUDASIM=1``), which runs
the same Python code on the processor.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import FunctionType
from typing import Any

from groma.errors import InputError

#: Threads of a block.
THREADS = 128


def cuda() -> Any:
    """Return the module ``numba.cuda``, or raise :class:`~groma.errors.InputError` where there is no device."""
    try:
        from numba import cuda as module
    except ImportError as error:
        raise InputError("CUDA needs the package numba-cuda: pip install numba-cuda.") from error
    if not module.is_available():
        raise InputError(
            "There is no CUDA device, or its driver is not found. Install numba-cuda for your driver; for tests set "
            "NUMBA_ENABLE_CUDASIM=1 before Python starts."
        )
    return module


def device_loop(loop: Callable, names: Mapping[str, Any] | None = None) -> Callable[..., None]:
    """Turn a loop that handles item ``cuda.grid(1)`` into a function that runs it for a number of items.

    Parameters
    ----------
    loop
        A plain function; it finds ``cuda`` among its globals.
    names
        What global names of the loop and of its kernels stand for on the device, where that is not what they stand for
        on the processor: numbers, or kernels (they are turned too).

    Returns
    -------
    callable
        Takes the number of items and the arguments of the loop. Arrays of NumPy are copied to the device and back.
    """
    module = cuda()
    compiled = module.jit(_Turn({**(names or {}), "cuda": module}).plain(loop))

    def run(count: int, *arguments: Any) -> None:
        if count:
            compiled[(count + THREADS - 1) // THREADS, THREADS](*arguments)
            module.synchronize()

    return run


class _Turn:
    """Turns functions under one choice of names; each only once."""

    def __init__(self, names: Mapping[str, Any]) -> None:
        self._names = names
        self._turned: dict[int, Any] = {}

    def function(self, kernel: Any) -> Any:
        """Return a device function."""
        plain = getattr(kernel, "py_func", kernel)
        if id(plain) not in self._turned:
            self._turned[id(plain)] = cuda().jit(device=True)(self.plain(plain))
        return self._turned[id(plain)]

    def plain(self, function: FunctionType) -> FunctionType:
        """Return a Python function with the same code, whose globals are what the device knows."""
        known = dict(function.__globals__)
        for name in function.__code__.co_names:
            if name in self._names:
                known[name] = self._names[name]
            if name in known and _is_kernel(known[name]):
                known[name] = self.function(known[name])
        return FunctionType(function.__code__, known, function.__name__, function.__defaults__)


def _is_kernel(value: Any) -> bool:
    """Whether a global name stands for code of ours: compiled, or plain where the compiler is switched off."""
    plain = getattr(value, "py_func", value)
    return isinstance(plain, FunctionType) and plain.__module__.startswith("groma.")
