# SPDX-License-Identifier: BSD-3-Clause
"""Finished stages of a long pipeline, kept in a folder so that an interrupted run goes on from them.

A stage is a file whose name ends in a key: the hash of the input, of everything that came before and of the options of
the stage. A file is there whole or not at all, and one with the right key is right; nothing else needs to be
remembered. Results are read back after they were written, so that a run that goes on computes with the same bits as
one that was never interrupted. The folder is locked while somebody works in it; the lock goes with the process,
however it ends.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path
from typing import IO, Any, Self, TypeVar

import numpy as np

from groma._typing import IntArray
from groma.adjustment.report import AdjustReport, AdjustResult
from groma.errors import FileFormatError, OutputError
from groma.features.segments import Segments
from groma.io import atomic_output, read_archive, write_archive
from groma.io.reading import reading
from groma.mapping.lines.build import LineMap
from groma.scene import Scene
from groma.solver.report import Iteration, SolveReport
from groma.solver.termination import Termination

_T = TypeVar("_T")
_LOCK = "lock"
_KEY_LENGTH = 12


def digest(*parts: object) -> str:
    """Return the hash of values: arrays by their content, dataclasses, mappings and sequences by theirs."""
    state = hashlib.sha256()
    _feed(state.update, parts)
    return state.hexdigest()


def _feed(update: Callable[[bytes], None], value: Any) -> None:
    if isinstance(value, np.ndarray):
        update(f"{value.dtype}{value.shape}".encode())
        update(np.ascontiguousarray(value).tobytes())
    elif is_dataclass(value) and not isinstance(value, type):
        update(f"{type(value).__module__}.{type(value).__qualname__}".encode())
        _feed(update, {item.name: getattr(value, item.name) for item in fields(value)})
    elif isinstance(value, Mapping):
        _feed(update, sorted(value.items(), key=lambda item: repr(item[0])))
    elif isinstance(value, (tuple, list)):
        update(f"[{len(value)}".encode())
        for item in value:
            _feed(update, item)
    else:
        update(repr(value).encode() + b"\0")


def digest_files(folder: Path, files: list[Path]) -> str:
    """Return a hash of which files there are; one that was written to since has another time."""
    stats = [(path, path.stat()) for path in files]
    return digest([(path.relative_to(folder).as_posix(), stat.st_size, stat.st_mtime_ns) for path, stat in stats])


class Stages:
    """Finished stages in a folder, for one input. A context: the folder is locked inside.

    Parameters
    ----------
    folder : Path
        Where the stages are kept; made where it is missing.
    key : str
        Hash of the input.

    Raises
    ------
    OutputError
        If the folder cannot be made or written, or if another process works in it.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self.folder = folder
        self._key = key
        self._lock: IO[str] | None = None

    def __enter__(self) -> Self:
        self._lock = _locked(self.folder)
        for unfinished in self.folder.glob(".*"):  # of a run that was killed while it wrote
            _remove(unfinished)
        return self

    def __exit__(self, *_: object) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def place(self, name: str) -> Path:
        """Return a folder of the present stage, for what it keeps while it works."""
        folder = self.folder / f"{name}-{self._key[:_KEY_LENGTH]}"
        self._drop_others(name, folder)
        return folder

    def scene(self, name: str, make: Callable[[], Scene], *options: object) -> Scene:
        """Return the saved scene of a stage, or make and save it."""
        return self._stage(name, make, write_archive, read_archive, options)

    def segments(self, name: str, make: Callable[[], list[Segments]], *options: object) -> list[Segments]:
        """Return the saved segments, or make and save them."""
        return self._stage(name, make, _write_segments, _read_segments, options)

    def line_map(self, name: str, make: Callable[[], LineMap], *options: object) -> LineMap:
        """Return the saved lines, or make and save them."""
        return self._stage(name, make, _write_line_map, _read_line_map, options)

    def adjusted(self, name: str, make: Callable[[], AdjustResult], *options: object) -> AdjustResult:
        """Return the saved scene and report of an adjustment, or make and save them."""
        reports: list[AdjustReport] = []

        def make_scene() -> Scene:
            result = make()
            reports.append(result.report)
            return result.scene

        scene = self.scene(name, make_scene, *options)
        report = self._stage(
            f"{name}-report", lambda: reports[0] if reports else make().report, _write_report, _read_report, ()
        )
        return AdjustResult(scene, report)

    def _stage(
        self,
        name: str,
        make: Callable[[], _T],
        write: Callable[[_T, Path], None],
        read: Callable[[Path], _T],
        options: tuple[object, ...],
    ) -> _T:
        self._key = digest(self._key, name, options)
        path = self.folder / f"{name}-{self._key[:_KEY_LENGTH]}.npz"
        if path.exists():
            # A file that cannot be read was damaged by somebody else: it is made again.
            with suppress(FileFormatError):
                return read(path)
            path.unlink()
        made = make()
        try:
            write(made, path)
        except OSError as error:
            raise OutputError(
                f"Cannot keep the finished stage {name!r} in {self.folder}: {system_reason(error)}. Make room there; "
                "the same command then goes on from the stages before it."
            ) from error
        self._drop_others(name, path)
        return read(path)

    def _drop_others(self, name: str, keep: Path) -> None:
        """Remove the same stage of other options or another input."""
        for entry in self.folder.glob(f"{name}-{'[0-9a-f]' * _KEY_LENGTH}*"):
            if entry != keep:
                _remove(entry)


def system_reason(error: OSError) -> str:
    """Return what the system said, without the place, of an error that may have been wrapped."""
    while isinstance(error, OutputError) and isinstance(error.__cause__, OSError):
        error = error.__cause__
    return (error.strerror or str(error)).rstrip(".")


def has_stages(folder: Path) -> bool:
    """Return whether something finished is kept in a folder."""
    return any(entry.name != _LOCK and not entry.name.startswith(".") for entry in folder.glob("*"))


def check_free(folder: Path) -> None:
    """Refuse a folder in which another process works, and one that cannot be written; it need not be there.

    Raises
    ------
    OutputError
        If another process works in it, or nothing can be kept there.
    """
    if folder.is_dir():
        _locked(folder).close()


def remove_stages(folder: Path) -> None:
    """Remove the folder of finished stages, unless another process works in it."""
    try:
        lock = _locked(folder)
    except OutputError:
        return
    lock.close()
    shutil.rmtree(folder, ignore_errors=True)


# ------------------------------------------------------------------------------------------------------------- lock


def _locked(folder: Path) -> IO[str]:
    """Return the open lock file of the folder; closing it gives the lock back."""
    try:
        while True:
            folder.mkdir(parents=True, exist_ok=True)
            file = (folder / _LOCK).open("a+", encoding="utf-8")
            if not _take(file):
                file.seek(0)
                owner = file.read().strip()
                file.close()
                raise OutputError(
                    f"Another run{f' (process {owner})' if owner else ''} works in {folder}. Wait until it has "
                    "finished, or choose another output."
                )
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file.fileno()), (folder / _LOCK).stat()):
                    break
            file.close()  # the folder was removed between opening and locking
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        return file
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(
            f"Cannot keep finished stages in {folder}: {error.strerror or error}. Choose an output where there is room "
            "and you may write."
        ) from error


def _take(file: IO[str]) -> bool:
    """Lock an open file; False if another process has."""
    try:
        if os.name == "nt":
            import msvcrt

            file.seek(1 << 20)  # beyond the text, which stays readable
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    return True


def _remove(entry: Path) -> None:
    if entry.is_dir():
        shutil.rmtree(entry, ignore_errors=True)
    else:
        with suppress(OSError):
            entry.unlink()


# ------------------------------------------------------------------------------------------------------------ files


def _write_arrays(path: Path, arrays: dict[str, Any]) -> None:
    with atomic_output(path, force=True) as draft, draft.open("wb") as file:
        np.savez(file, **arrays)


def _read_arrays(path: Path) -> dict[str, Any]:
    with reading(path, "finished stage"), np.load(path, allow_pickle=False) as saved:
        return {name: saved[name] for name in saved.files}


def _write_segments(segments: list[Segments], path: Path) -> None:
    arrays = {name: _concatenated([getattr(s, name) for s in segments]) for name in ("ends", "sigma", "strength")}
    _write_arrays(path, {"counts": np.array([len(s) for s in segments], np.int64), **arrays})


def _read_segments(path: Path) -> list[Segments]:
    saved = _read_arrays(path)
    with reading(path, "finished stage"):
        columns = (_parted(saved[name], saved["counts"]) for name in ("ends", "sigma", "strength"))
        return [Segments(ends, sigma, strength) for ends, sigma, strength in zip(*columns, strict=True)]


_LISTS = ("outcomes", "neighbors")


def _write_line_map(line_map: LineMap, path: Path) -> None:
    arrays: dict[str, Any] = {}
    for item in fields(line_map):
        value = getattr(line_map, item.name)
        if item.name in _LISTS:
            arrays[item.name] = _concatenated(list(value)).astype(np.int64)
            arrays[f"{item.name}.counts"] = np.array([len(part) for part in value], np.int64)
        elif isinstance(value, dict):
            arrays[item.name] = np.array(json.dumps(value))
        else:
            arrays[item.name] = value
    _write_arrays(path, arrays)


def _read_line_map(path: Path) -> LineMap:
    saved = _read_arrays(path)
    with reading(path, "finished stage"):
        for name in _LISTS:
            saved[name] = tuple(_parted(saved[name], saved.pop(f"{name}.counts")))
        saved["seconds"] = json.loads(str(saved["seconds"]))
        return LineMap(**saved)


def _write_report(report: AdjustReport, path: Path) -> None:
    content = asdict(replace(report, solve=replace(report.solve, termination=report.termination.key)))  # type: ignore[arg-type]
    _write_arrays(path, {"report": np.array(json.dumps(content, default=_number))})


def _read_report(path: Path) -> AdjustReport:
    saved = _read_arrays(path)
    with reading(path, "finished stage"):
        content = json.loads(str(saved["report"]))
        solve = content.pop("solve")
        solve["termination"] = next(end for end in Termination if end.key == solve["termination"])
        solve["history"] = [Iteration(**step) for step in solve["history"]]
        for name in ("warnings", "stages"):
            content[name] = tuple(content[name])
        return AdjustReport(**content, solve=SolveReport(**solve))


def _number(value: Any) -> Any:
    return value.tolist()


def _concatenated(parts: list[Any]) -> Any:
    return np.concatenate(parts) if parts else np.zeros(0)


def _parted(array: Any, counts: IntArray) -> list[Any]:
    return np.split(array, np.cumsum(counts)[:-1]) if len(counts) else []


__all__ = ["Stages", "check_free", "digest", "digest_files", "has_stages", "remove_stages", "system_reason"]
