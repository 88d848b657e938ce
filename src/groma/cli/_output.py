# SPDX-License-Identifier: BSD-3-Clause
"""Writing results: complete or not at all, and never over something that was there unless asked to."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from groma.errors import OutputError

#: A folder that holds anything else is not a result of groma, and ``--force`` does not replace it.
_RESULT_NAMES = {"structures", "report.html", "report.json", "adjusted.npz", "rigs", "sparse", "truth", "start"}
_RESULT_SUFFIXES = {".bin", ".txt", ".npz", ".json", ".html", ".npy", ".obj", ".ply"}


def check_output(path: Path, force: bool) -> None:
    """Refuse early, before any work is done, what :func:`atomic_output` would refuse at the end."""
    parent = path.absolute().parent
    if not parent.is_dir():
        raise OutputError(f"Cannot write {path}: the folder {parent} does not exist. Make it first.")
    if not os.access(parent, os.W_OK):
        raise OutputError(f"Cannot write {path}: the folder {parent} is not writable. Choose another place.")
    if not (path.exists() or path.is_symlink()):
        return
    if not force:
        raise OutputError(f"{path} exists already. Pass --force to replace it, or choose another name.")
    if path.is_dir():
        foreign = [
            entry.name
            for entry in path.iterdir()
            if entry.name not in _RESULT_NAMES and entry.suffix not in _RESULT_SUFFIXES
        ]
        if foreign:
            raise OutputError(
                f"{path} holds {foreign[0]!r}, which groma did not write; --force does not replace such a folder. "
                "Choose another name."
            )


@contextmanager
def atomic_output(path: Path, force: bool, workshop_in: Path | None = None) -> Iterator[Path]:
    """Yield a place to write a file or folder to; it becomes ``path`` when the block ends well, else it vanishes.

    It is built in ``workshop_in`` (default: beside ``path``).
    """
    from groma.io._atomic import atomic_output as complete_or_not_at_all

    check_output(path, force)
    with complete_or_not_at_all(path, force, workshop_in) as draft:
        yield draft


def check_json(target: str | None, force: bool) -> None:
    """Refuse a report that could not be written, before any work is done."""
    if target not in (None, "-"):
        path = Path(target)
        if path.is_dir():
            raise OutputError(f"--json {target} is a folder. Give a file name, or '-' for standard output.")
        check_output(path, force)


def write_json(target: str | None, content: dict[str, object], force: bool = False) -> None:
    """Write ``content`` to the file ``target``, to standard output when it is '-', nowhere when it is None.

    Numbers that are not finite become null, which every JSON reader accepts.
    """
    if target is None:
        return
    text = json.dumps(plain(content), indent=2, allow_nan=False) + "\n"
    if target == "-":
        print(text, end="", flush=True)
        return
    with atomic_output(Path(target), force) as draft:
        draft.write_text(text, encoding="utf-8")


def plain(value: object) -> object:
    """Turn NumPy numbers and arrays, enumerations and paths into what JSON knows; not-finite numbers into None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (str, bool, int)) or value is None:
        return value
    if hasattr(value, "tolist"):
        return plain(value.tolist())  # type: ignore[attr-defined]
    if isinstance(value, float):
        return value if value - value == 0 else None
    return str(value)
