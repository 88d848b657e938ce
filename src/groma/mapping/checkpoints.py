# SPDX-License-Identifier: BSD-3-Clause
"""Checkpoints of a long pipeline: an interrupted run continues after the last finished stage.

The result of a stage is a file whose name ends in a key: the hash of the input, of all stages before it and of the
options that the stage depends on. Files are written atomically, so a file with the right key is valid and no other
state is needed. Results are read back after they are written; a continued run therefore computes with the same bits as
an uninterrupted one. The folder is locked while a process works in it.
"""

from __future__ import annotations

import hashlib
import shutil
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import IO, Any, Generic, Self, TypeVar

import numpy as np

from groma.errors import FileFormatError, OutputError
from groma.execution import beside, num_threads
from groma.mapping.checkpoint_files import FileKind
from groma.mapping.folder_lock import LOCK, lock_folder

_Options = TypeVar("_Options")
_Result = TypeVar("_Result")
#: Characters of a key in the format of names of files.
_KEY_LENGTH = 12


def digest(*parts: object) -> str:
    """Return the hash of values: arrays by their content, dataclasses, mappings and sequences by theirs.

    Of other objects it is their repr, else their class and attributes.
    """
    state = hashlib.sha256()
    _feed(state.update, parts)
    return state.hexdigest()


def _feed(update: Callable[[bytes], None], value: Any) -> None:
    if isinstance(value, np.ndarray):
        update(f"{value.dtype}{value.shape}".encode())
        update(np.ascontiguousarray(value).tobytes())
    elif is_dataclass(value) and not isinstance(value, type):
        update(_name(value).encode())
        _feed(update, {item.name: getattr(value, item.name) for item in fields(value)})
    elif isinstance(value, Mapping):
        _feed(update, sorted(value.items(), key=lambda item: repr(item[0])))
    elif isinstance(value, (tuple, list)):
        update(f"[{len(value)}".encode())
        for item in value:
            _feed(update, item)
    elif _is_plain(value):  # a repr with nothing but its address
        held = getattr(value, "__dict__", {})
        _feed(update, [_name(value), {name: _name(one) if _is_plain(one) else one for name, one in held.items()}])
    else:
        update(repr(value).encode() + b"\0")


def _is_plain(value: Any) -> bool:
    return type(value).__repr__ is object.__repr__ and not is_dataclass(value)


def _name(value: Any) -> str:
    return f"{type(value).__module__}.{type(value).__qualname__}"


def digest_files(folder: Path, files: list[Path]) -> str:
    """Return a hash of which files there are; one that was written to since has another time."""
    stats = [(path, path.stat()) for path in files]
    return digest([(path.relative_to(folder).as_posix(), stat.st_size, stat.st_mtime_ns) for path, stat in stats])


@dataclass(frozen=True)
class Stage(Generic[_Options, _Result]):
    """A function from values to a value, with a name under which its result is kept. Made by :func:`stage`.

    The function takes values, options, and a progress callback: ``function(*values, options, say)``.
    """

    name: str
    kind: FileKind[_Result]
    #: Which of the options the result depends on.
    depends: Callable[[_Options], object]
    function: Callable[..., _Result]

    def __call__(self, *values: Any) -> _Result:
        """Call the function; nothing is kept."""
        return self.function(*values)


def stage(
    name: str, kind: FileKind[_Result], depends: Callable[[Any], object] = lambda options: None
) -> Callable[[Callable[..., _Result]], Stage[Any, _Result]]:
    """Make a function a stage."""
    return lambda function: Stage(name, kind, depends, function)


class Stages(Generic[_Options]):
    """Finished stages in a folder, for one input. A context: the folder is locked inside.

    Parameters
    ----------
    folder : Path
        Where the stages are kept; made where it is missing.
    key : str
        Hash of the input.
    options : object
        Given to every stage.
    say : callable, optional
        Passed to every stage: called with a name, the number of parts done, and their total.

    Raises
    ------
    OutputError
        If the folder cannot be made or written, or if another process works in it.
    """

    def __init__(
        self, folder: Path, key: str, options: _Options, say: Callable[[str, int, int], None] | None = None
    ) -> None:
        self.folder, self.options = folder, options
        self.say = say or (lambda doing, done, total: None)
        self._key = key
        self._lock: IO[str] | None = None

    def __enter__(self) -> Self:
        self._lock = lock_folder(self.folder)
        for unfinished in self.folder.glob(".*"):  # of a run that was killed while it wrote
            _remove(unfinished)
        return self

    def __exit__(self, *_: object) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def folder_of(self, name: str) -> Path:
        """Return a folder of the current stage for its intermediate files."""
        folder = self.folder / f"{name}-{self._key[:_KEY_LENGTH]}"
        self._drop_others(name, folder)
        return folder

    def run(self, stage: Stage[_Options, _Result], *values: Any, given: object = None, tag: str = "") -> _Result:
        """Return the kept result of a stage, or make it and keep it.

        Parameters
        ----------
        stage : Stage
            What to do.
        values
            What it is done with. They follow from the input and the stages before.
        given : object, optional
            What came in from elsewhere, and is not in the hash of the input.
        tag : str
            Ends the name, of a stage that is done more than once.
        """
        return self._kept(stage, self._file_of(stage, given, tag), values, self.say)

    def run_beside(
        self, words: str, aside: tuple[Stage[_Options, Any], Any], stage: Stage[_Options, _Result], *values: Any,
        given: object = None,
    ) -> tuple[Any, _Result]:  # fmt: skip
        """Return the results of two stages, of which neither needs the other's.

        The first, which is given with its value, is done in a thread of this process where there are several, and is
        said with some words when it begins; where there is one, it is done before the other.
        """
        files = self._file_of(aside[0], None, ""), self._file_of(stage, given, "")
        if num_threads() < 2:
            first = self._kept(aside[0], files[0], aside[1:], self.say)
            return first, self._kept(stage, files[1], values, self.say)
        if not files[0].exists():
            self.say(words, 0, 1)
        found: list[Any] = []
        is_left = threading.Event()

        def go_on(doing: str, done: int, total: int) -> None:
            if is_left.is_set():
                raise KeyboardInterrupt

        def do_aside() -> None:
            found.append(self._kept(aside[0], files[0], aside[1:], go_on))

        with beside(do_aside):
            try:
                result = self._kept(stage, files[1], values, self.say)
            except BaseException:
                is_left.set()
                raise
        return found[0], result

    def _file_of(self, stage: Stage[_Options, Any], given: object, tag: str) -> Path:
        """Return the file of the next stage."""
        name = stage.name + tag
        self._key = digest(self._key, name, stage.depends(self.options), given)
        return self.folder / f"{name}-{self._key[:_KEY_LENGTH]}.npz"

    def _kept(
        self, stage: Stage[_Options, _Result], path: Path, values: tuple[Any, ...], say: Callable[[str, int, int], None]
    ) -> _Result:
        """Return what a file holds, or make it."""
        kind, name = stage.kind, path.stem[: -_KEY_LENGTH - 1]
        if path.exists():
            # An unreadable file was damaged from outside: it is made again.
            with suppress(FileFormatError):
                return kind.read(path)
            path.unlink()
        made = stage(*values, self.options, say)
        try:
            kind.write(made, path)
        except OSError as error:
            raise OutputError(
                f"Cannot keep the finished stage {name!r} in {self.folder}: {system_reason(error)}. Make room there; "
                "the same command then goes on from the stages before it."
            ) from error
        self._drop_others(name, path)
        return kind.read(path)

    def _drop_others(self, name: str, keep: Path) -> None:
        """Remove the same stage of other options or another input."""
        for entry in self.folder.glob(f"{name}-{'[0-9a-f]' * _KEY_LENGTH}*"):
            if not entry.name.startswith(keep.stem):
                _remove(entry)


def system_reason(error: OSError) -> str:
    """Return the message of the system, without the path, of an error that may have been wrapped."""
    while isinstance(error, OutputError) and isinstance(error.__cause__, OSError):
        error = error.__cause__
    return (error.strerror or str(error)).rstrip(".")


def has_stages(folder: Path) -> bool:
    """Return whether something finished is kept in a folder."""
    return any(entry.name != LOCK and not entry.name.startswith(".") for entry in folder.glob("*"))


def check_free(folder: Path) -> None:
    """Refuse a folder in which another process works, and one that cannot be written; it need not be there.

    Raises
    ------
    OutputError
        If another process works in it, or nothing can be kept there.
    """
    if folder.is_dir():
        lock_folder(folder).close()


def remove_stages(folder: Path) -> None:
    """Remove the folder of finished stages, unless another process works in it."""
    try:
        lock = lock_folder(folder)
    except OutputError:
        return
    lock.close()
    shutil.rmtree(folder, ignore_errors=True)


def _remove(entry: Path) -> None:
    if entry.is_dir():
        shutil.rmtree(entry, ignore_errors=True)
    else:
        with suppress(OSError):
            entry.unlink()
