# SPDX-License-Identifier: BSD-3-Clause
"""pycolmap's own log, kept off the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def quiet(pycolmap: Any) -> Iterator[None]:
    """Silence the log of pycolmap; its errors are reported by groma."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
