# SPDX-License-Identifier: BSD-3-Clause
"""pycolmap's own log, kept off the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def quiet(pycolmap: Any) -> Iterator[None]:
    """Let pycolmap say nothing: what it reports comes back as one line of ours."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
