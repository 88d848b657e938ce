# SPDX-License-Identifier: BSD-3-Clause
"""pycolmap, loaded so that it does no harm to the process around it.

zlib must be loaded first: pycolmap's wheel (4.2) exports functions of the same names, which otherwise break it (heap
corruption). And pycolmap takes SIGTERM, and answers it with a page of addresses; it is given back.
"""

from __future__ import annotations

import signal
import threading
import zlib  # noqa: F401
from typing import Any


def load_pycolmap() -> Any:
    """Return the module :mod:`pycolmap`."""
    import pycolmap

    if threading.current_thread() is threading.main_thread():
        before = signal.getsignal(signal.SIGTERM)  # as Python remembers it
        if before is not None:
            signal.signal(signal.SIGTERM, before)
    return pycolmap
