# SPDX-License-Identifier: BSD-3-Clause
"""A folder for compiled functions where none of the usual ones can be written: a service without a home, a container.

Only this process and those that it starts see it, and it ends with this process.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile

from numba.core import config

#: The folder; None as long as none was needed, empty if none could be made.
_own: str | None = None


def is_own() -> bool:
    """Whether compiled functions are kept there, and end with this process."""
    return bool(_own)


def take_own() -> bool:
    """Keep compiled functions there from now on; return False if they are already, or no folder can be made."""
    global _own
    if _own is not None:
        return False
    try:
        _own = tempfile.mkdtemp(prefix="groma-")
    except OSError:
        _own = ""
        return False
    atexit.register(shutil.rmtree, _own, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = config.CACHE_DIR = _own  # type: ignore[attr-defined]
    return True
