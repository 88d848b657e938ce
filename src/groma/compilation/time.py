# SPDX-License-Identifier: BSD-3-Clause
"""How much time goes into compiled code: compiling it, or loading it from disk."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass
class Compilation:
    """What went into compiled code."""

    seconds: float = 0.0
    #: Whether something was compiled, by this process or one beside it, and not all of it loaded.
    compiled: bool = False


@contextmanager
def compilation_time() -> Iterator[Compilation]:
    """Measure what goes into compiled code inside a ``with`` block; the value is filled at its end."""
    from numba.core import event

    from groma._kernels.cache import counts

    found, before = Compilation(), counts.compiled + counts.unsaved + counts.missed
    # Numba holds its lock for as long as it compiles or loads, in every thread.
    with event.install_listener("numba:compiler_lock", event.TimingListener()) as listener:
        yield found
    found.seconds = listener.duration if listener.done else 0.0
    found.compiled = counts.compiled + counts.unsaved + counts.missed > before
