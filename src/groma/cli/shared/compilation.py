# SPDX-License-Identifier: BSD-3-Clause
"""How much of the time of a command goes into compiled code: compiling it, or loading it from disk."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass
class Compilation:
    """What went into compiled code."""

    seconds: float = 0.0
    #: Whether something was compiled, and not all of it loaded.
    compiled: bool = False


@contextmanager
def compilation_time() -> Iterator[Compilation]:
    """Measure what goes into compiled code inside a ``with`` block; the value is filled at its end."""
    from numba.core import event

    from groma._numba_cache import counts

    found, before = Compilation(), counts.compiled + counts.unsaved
    # Numba holds its lock for as long as it compiles or loads, in every thread.
    with event.install_listener("numba:compiler_lock", event.TimingListener()) as listener:
        yield found
    found.seconds = listener.duration if listener.done else 0.0
    found.compiled = counts.compiled + counts.unsaved > before


def spent(total: float, compilation: float, compiled: bool) -> str:
    """Return for example ``0.13 s, and 0.98 s to load compiled code``.

    Parameters
    ----------
    total, compilation : float
        Seconds of the work as a whole, and those of them that went into compiled code.
    compiled : bool
        Whether it was compiled, and not only loaded.
    """
    apart = f", and {compilation:.2f} s to {'compile' if compiled else 'load compiled code'}"
    return f"{max(total - compilation, 0.0):.2f} s{apart if compilation >= 0.005 else ''}"


__all__ = ["Compilation", "compilation_time", "spent"]
