# SPDX-License-Identifier: BSD-3-Clause
"""pycolmap, loaded so that it does no harm to the process around it; its log kept off the terminal; its databases.

zlib must be loaded first: pycolmap's wheel (4.2) exports functions of the same names, which otherwise break it (heap
corruption). And pycolmap takes SIGTERM, and answers it with a page of addresses; it is given back.
"""

from __future__ import annotations

import signal
import threading
import zlib  # noqa: F401
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def load_pycolmap() -> Any:
    """Return the module :mod:`pycolmap`."""
    import pycolmap

    if threading.current_thread() is threading.main_thread():
        before = signal.getsignal(signal.SIGTERM)  # as Python remembers it
        if before is not None:
            signal.signal(signal.SIGTERM, before)
    return pycolmap


@contextmanager
def quiet(pycolmap: Any) -> Iterator[None]:
    """Silence the log of pycolmap; its errors are reported by groma."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


@contextmanager
def opened(pycolmap: Any, database: Path) -> Iterator[Any]:
    """Open a database, and make it where there is none."""
    content = pycolmap.Database.open(str(database))
    try:
        yield content
    finally:
        content.close()


def find_sift(pycolmap: Any, database: Path, images: Path, names: Sequence[str], extraction: Any, reader: Any) -> None:
    """Find the features of images that are entered in a database, and write them to it."""
    pycolmap.extract_features(
        database,
        images,
        image_names=names,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
