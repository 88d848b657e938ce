# SPDX-License-Identifier: BSD-3-Clause
"""Where compiled functions lie on disk, and when they are valid.

**Where.** The first of these that can be written: the folder in ``NUMBA_CACHE_DIR``; ``__pycache__`` beside the
sources; Numba's folder of the user (``~/.cache/numba`` on Linux), for installations that are read-only; a folder of
this process and those that it starts, which ends with it. Where none can be written, functions are compiled in every
process; nothing fails. Numba's own functions, such as ``np.empty``, lie with those of the package.

**When.** One file per function and argument types. It opens with a digest of all that it depends on: versions, the
processor and its instructions, the argument types, the function and everything it calls, inlines or reads as a constant
(:mod:`groma._kernels.digest`). Numba's own cache compares the file of the function alone and would return old numbers
after a kernel in another file was edited. Here an edit compiles what uses the edited kernel again, and nothing else. A
file whose digest or checksum is wrong is compiled again and replaced, so that a cache shared by several versions or
processors is never wrong.

The name of the file holds the function, the argument types, the processor, and where the types stand for a camera model
the names of its kernels: two models that have the same number in two processes keep files of their own.

**Several processes.** Files are written under another name and moved into place, so a reader finds a whole file or
none. There is no index: Numba's own keeps one per function, and two processes that compile the same function for
different types at the same moment can leave an entry there that names the other one's code. A function that another
process compiles at the moment is waited for (:mod:`groma._kernels.turns`).
"""

from __future__ import annotations

import gc
import hashlib
import json
import os
import pickle
import sys
import threading
import uuid
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from llvmlite.binding import get_host_cpu_features, get_process_triple
from numba.core import config, sigutils
from numba.core.caching import FunctionCache, NullCache
from numba.core.registry import cpu_target
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps

from groma._counted import counted
from groma._kernels import digest as kernel_digest
from groma._kernels import folder as kernel_folder
from groma._kernels import inner as kernel_inner
from groma._kernels import turns as kernel_turns
from groma._kernels.parts import is_versioned, module_of

#: A file that contains one of these holds compiled code, or chooses it.
_MARKS = (b"_numba import", b"njit(", b"numba.extending", b"llvmlite")
_SUFFIX = ".nbc"
_PACKAGE = Path(__file__).parents[1]
#: Folder of the package with functions that were compiled ahead; only in wheels for one platform.
SHIPPED = "_compiled_ahead"
_DIGEST, _CHECKSUM = 64, 8  # letters and bytes that a file begins with (its format)


@lru_cache(maxsize=1)
def source_stamp() -> str:
    """Return a digest of all files of the package that hold compiled code; it changes if any compiled function does."""
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        content = path.read_bytes()
        if any(mark in content for mark in _MARKS):
            digest.update(path.name.encode() + b"\0" + content)
    return digest.hexdigest()


@dataclass
class Counts:
    """What happened in this process so far."""

    #: Functions (for given argument types) that were compiled and written to disk.
    compiled: int = 0
    #: Functions that were found on disk.
    loaded: int = 0
    #: Functions that were compiled and could not be written.
    unsaved: int = 0
    #: Functions called from Python that were not found; another process may have compiled them meanwhile.
    missed: int = 0


counts = Counts()
#: Called with this process's counts whenever something that Python calls is not there and must be compiled.
on_miss: list[Callable[[Counts], None]] = []
#: Files that were written or found, and which function, for which argument types.
_used: dict[Path, tuple[str, str, tuple]] = {}
_lock = threading.Lock()
#: Held while a file is written; a process that ends at once takes it first.
writing = threading.Lock()


@dataclass(frozen=True)
class _Shipped:
    """Functions that were compiled ahead for a named processor, and came with the installation."""

    folder: Path
    #: As Numba names processors: system, name, instructions.
    processor: tuple[str, str, str]


@lru_cache(maxsize=1)
def _shipped() -> _Shipped | None:
    """Return what came with the installation, if this processor has all that it was compiled for."""
    place = _PACKAGE / SHIPPED
    try:
        said = json.loads((place / "processor.json").read_text())
    except (OSError, ValueError):
        return None
    host = get_host_cpu_features()
    wanted = [name[1:] for name in said["processor"][2].split(",") if name.startswith("+")]
    chosen = config.CPU_NAME is not None or config.CPU_FEATURES is not None  # type: ignore[attr-defined]
    if chosen or said["processor"][0] != get_process_triple() or not all(host.get(name) for name in wanted):
        return None
    return _Shipped(place, tuple(said["processor"]))


@dataclass(frozen=True)
class _Key:
    """What tells the compiled forms of one function apart."""

    #: Of argument types, processor and camera model: the same function replaces its older self.
    name: str
    #: Of everything.
    content: str


class _Files:
    """The files of one function; takes the place of Numba's index and data files."""

    def __init__(self, folder: str, stem: str) -> None:
        self._folder, self._stem = Path(folder), stem

    def flush(self) -> None:
        """Remove all files of the function."""
        for path in self._folder.glob(f"{self._stem}.*{_SUFFIX}"):
            path.unlink(missing_ok=True)

    def load(self, key: _Key | None) -> Any:
        """Return what was compiled for a key, or None."""
        if key is None:
            return None
        path = self.path(key)
        try:
            content = path.read_bytes()
        except OSError:
            return None
        payload = content[_DIGEST + _CHECKSUM :]
        if content[: _DIGEST + _CHECKSUM] != _head(key, payload):
            return None
        try:
            found = pickle.loads(payload)
        except (ImportError, AttributeError):  # it calls a function that is not there any more
            return None
        with _lock:
            counts.loaded += 1
        return found

    def has(self, key: _Key) -> bool:
        """Whether there is a file for a key that is valid, going by its head."""
        try:
            with self.path(key).open("rb") as file:
                return file.read(_DIGEST) == key.content.encode()
        except OSError:
            return False

    def save(self, key: _Key | None, data: Any) -> None:
        """Write what was compiled for a key."""
        if key is None:
            return
        path, payload = self.path(key), dumps(data)
        draft = path.with_name(f"{path.name}.{uuid.uuid4().hex[:16]}.tmp")  # unique on a shared drive too
        with writing:
            try:
                draft.write_bytes(_head(key, payload) + payload)
                os.replace(draft, path)
            except OSError:
                draft.unlink(missing_ok=True)
                raise
        with _lock:
            counts.compiled += 1

    def path(self, key: _Key) -> Path:
        """Return the file of a key."""
        return self._folder / f"{self._stem}.{key.name[:16]}{_SUFFIX}"


def _digest(content: object) -> str:
    return hashlib.sha256(repr(content).encode()).hexdigest()


def _head(key: _Key, payload: bytes) -> bytes:
    return f"{key.content}{zlib.crc32(payload):08x}".encode()


def environment_digest() -> str:
    """Return a digest of all that compiled functions depend on besides themselves and their arguments."""
    target: Any = cpu_target.target_context
    processor = target.codegen().magic_tuple()
    return _digest((kernel_digest.environment(), source_stamp(), processor))


class _Cache(FunctionCache):
    _impl_class = kernel_inner.Results

    def __init__(self, function: Any, dispatcher: Any = None) -> None:
        self._is_ours = not is_versioned(module_of(function))
        super().__init__(function if self._is_ours else counted)
        self._function = function
        self._compiled = function if dispatcher is None else dispatcher
        python = f"py{sys.version_info[0]}{sys.version_info[1]}{getattr(sys, 'abiflags', '')}"
        stem = f"{function.__module__.rpartition('.')[2]}.{function.__qualname__}-{python}"
        self._stem = stem.replace("<", "").replace(">", "")
        self._cache_file = _Files(self.cache_path, self._stem)
        #: Turns of what is being compiled, one inside the other; None where nothing is kept.
        self._turns: list[tuple[Path, str] | None] = []

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        """Return a key; None where functions or objects are arguments, whose types hold for this process only."""
        return self._key(sig, codegen.magic_tuple())

    def _key(self, sig: Any, processor: tuple) -> Any:
        kinds = repr(sig)
        if " at 0x" in kinds or "jitclass." in kinds:
            return None
        found = kernel_digest.dependence(self._compiled, sigutils.normalize_signature(sig)[0])
        if not self._is_ours and not found.is_complete:
            return None
        variant = "for linking" if kernel_inner.is_inside() else "for Python"
        content = _digest((kernel_digest.environment(), kinds, processor, found.content, variant))
        return _Key(_digest((kinds, processor, found.selected, variant)), content)

    def take_turn(self, sig: Any, target_context: Any) -> bool:
        """Take the turn to compile the function; False if it is there or another process has the turn."""
        key = self._index_key(sig, target_context.codegen())
        return key is not None and not self._cache_file.has(key) and kernel_turns.take(*self._turn(key))

    def is_kept(self, sig: Any, target_context: Any) -> bool:
        """Whether the function lies on disk, so that it need only be loaded."""
        key = self._index_key(sig, target_context.codegen())
        return key is not None and (self._cache_file.has(key) or self._from_shipped(sig, _Files.has) is True)

    def _from_shipped(self, sig: Any, ask: Callable[[_Files, _Key], Any]) -> Any:
        """Ask the functions that came with the installation for one; None where there are none."""
        shipped = _shipped()
        if shipped is None:
            return None
        place = _Files(str(shipped.folder / self._function.__module__), self._stem)
        return ask(place, self._key(sig, shipped.processor))

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load, without making the compiler ready to compile, which Numba does first and which takes longer."""
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            key = self._index_key(sig, target_context.codegen()) if self._enabled else None
            data = self._find(key, sig)
            if data is None:
                self._turns.append(None if key is None else self._turn(key))
                return None
            if key is not None:
                self._note(self._cache_file.path(key), sig)
            return self._impl.rebuild(target_context, data)

    def _find(self, key: _Key | None, sig: Any) -> Any:
        """Return what was compiled, by this process or another; or take the turn to compile it, and return None."""
        if key is None:
            return None
        if (data := self._cache_file.load(key)) is None:
            data = self._from_shipped(sig, _Files.load)
        if data is not None:
            return data
        if not kernel_inner.is_inside():
            counts.missed += 1
            for call in on_miss:
                call(counts)
        turn = self._turn(key)
        kernel_turns.wait(*turn, lambda: self._cache_file.has(key))
        if (data := self._cache_file.load(key)) is not None:
            kernel_turns.give_back(*turn)
        return data

    def _turn(self, key: _Key) -> tuple[Path, str]:
        """Return folder and name of the turn to compile the function; a key may be that of another function, too."""
        return Path(self.cache_path), _digest((self._stem, key.name))

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save; a full disk, or a folder that became read-only, costs time in the next process and nothing else."""
        try:
            super().save_overload(sig, data)
            if (key := self._index_key(sig, data.codegen)) is not None:
                self._note(self._cache_file.path(key), sig)
        except OSError:
            with _lock:
                counts.unsaved += 1
        finally:
            self.end_turn()

    def end_turn(self) -> None:
        """Let other processes compile what this one has compiled, or could not compile."""
        if self._turns and (turn := self._turns.pop()) is not None:
            kernel_turns.give_back(*turn)

    def _note(self, path: Path, sig: Any) -> None:
        if kernel_inner.is_inside():
            return
        with _lock:
            _used[path] = self._function.__module__, self._function.__qualname__, sigutils.normalize_signature(sig)[0]


class _Unopened:
    """Stands for the files of a compiled function until something is asked of them."""

    def __init__(self, dispatcher: Any) -> None:
        self._dispatcher = dispatcher

    def __getattr__(self, name: str) -> Any:
        opened = _opened(self._dispatcher)
        self._dispatcher._cache = opened
        _watch(self._dispatcher._compiler, opened)
        return getattr(opened, name)


def _opened(dispatcher: Any) -> Any:
    """Return the files of a compiled function."""
    source = Path(dispatcher.py_func.__code__.co_filename)
    while True:
        try:
            return _Cache(dispatcher.py_func, dispatcher)
        except (RuntimeError, OSError):  # no folder that can be written, or no source: loops written for a notebook
            if not (source.is_file() and kernel_folder.take_own()):
                return NullCache()


def _watch(compiler: Any, cache: Any) -> None:
    """Collect no garbage while a function is compiled, a tenth of the time, and end its turn if that fails."""
    compile_function = compiler.compile

    def compile_watched(*arguments: Any) -> Any:
        collects = gc.isenabled()
        gc.disable()
        try:
            with kernel_inner.one_deeper():
                return kernel_inner.completed(compile_function(*arguments))
        except BaseException:
            if isinstance(cache, _Cache):
                cache.end_turn()
            raise
        finally:
            if collects:
                gc.enable()

    compiler.compile = compile_watched


def keep_on_disk(dispatcher: Any) -> Any:
    """Let a compiled function be kept on disk where some folder can be written; return it."""
    if hasattr(dispatcher, "py_func"):  # a plain function without the compiler
        dispatcher._cache = _Unopened(dispatcher)
        kernel_inner.tell_apart(dispatcher, keep_on_disk)
    return dispatcher


def folder() -> Path | None:
    """Return the folder of compiled functions of the package's own files; None where none can be written.

    Those of sub-packages lie in folders of theirs, by the same rule. ``counted`` stands for any function of these.
    """
    try:
        return Path(_Cache(counted).cache_path)
    except RuntimeError:
        return None


def used_files() -> list[Path]:
    """Return the files of the package's own functions that were written or found by this process."""
    package = __name__.partition(".")[0]
    with _lock:
        return sorted(path for path, (module, *_) in _used.items() if module.partition(".")[0] == package)


def used_paths() -> list[Path]:
    """Return the files of :func:`used_functions`."""
    with _lock:
        return list(_used)


def used_functions() -> list[tuple[str, str, tuple]]:
    """Return module, name and argument types of what was written or found by this process, in the order of first use.

    In a process that compiles nothing these are the functions that Python calls, and no others.
    """
    with _lock:
        return list(_used.values())
