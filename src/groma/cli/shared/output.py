# SPDX-License-Identifier: BSD-3-Clause
"""Writing results: atomically, and never over an existing file without --force."""

import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from groma.bounded.json_text import json_text
from groma.errors import OutputError

#: Files that commands write into folders. A folder with any other file is not replaced by ``--force``.
_RESULTS = re.compile(
    r"(cameras|images|points3D|rigs|frames)\.(bin|txt)|structures|(scene|start|truth)\.npz|(lines|planes)\.(ply|obj)|"
    r"summary\.json|adjustment\.txt|report\.html|trajectory\.txt|poses\.txt|localized\.json|(submap|part)_\d+"
)

#: Files that a running track keeps (:mod:`groma.tracking.journal`).
_JOURNAL = {"frames.txt", "keyframes.txt", "statuses.txt", "trajectory.txt", "scene.npz", "now.npz", "now.draft"}

#: Ends of paths that are the same in every project, of COLMAP's and others' layouts.
_OF_LAYOUTS = re.compile(r"(/(sparse(/\d+)?|dense|images?|photos|photographs|frames|model))+$", re.IGNORECASE)


def subject(path: Path) -> str:
    """Return a name for headings: ``castle`` for ``castle/images`` and ``castle/sparse/0``."""
    whole = Path(os.path.abspath(path))  # also of .. and .
    return Path(_OF_LAYOUTS.sub("", whole.as_posix())).name or whole.name


def check_outputs(
    force: bool, output: Path | None, *files: Path | None, json_target: str | None = None, file: bool = False
) -> None:
    """Refuse, before any work, outputs that cannot be written, or that are given twice.

    Parameters
    ----------
    force : bool
        Replace existing files.
    output : Path, optional
        The result, a file or a folder.
    files : Path or None
        Further results, which are files; None: not requested.
    json_target : str, optional
        Value of --json.
    file : bool
        ``output`` is a file, too.
    """
    report = None if json_target in (None, "-") else Path(json_target)
    taken: set[Path] = set()
    for number, path in enumerate((output, *files, report)):
        if path is None:
            continue
        check_output(path, force, file=number > 0 or file)
        if path.absolute() in taken:
            raise OutputError(f"{path} is given for two results, and one would replace the other. Name them apart.")
        taken.add(path.absolute())


def check_output(path: Path, force: bool, file: bool = False) -> None:
    """Refuse, before any work, what :func:`atomic_output` would refuse at the end. It makes folders that are missing.

    Parameters
    ----------
    path : Path
        The result.
    force : bool
        Replace it if it exists and groma wrote it.
    file : bool
        The result is a file: it never replaces a folder.
    """
    parent = next(folder for folder in path.absolute().parents if folder.exists())
    if not parent.is_dir():
        raise OutputError(f"Cannot write {path}: {parent} is a file. Choose another place.")
    try:
        tempfile.TemporaryDirectory(prefix=".groma.", dir=parent).cleanup()
    except OSError as error:
        raise OutputError(
            f"Cannot write {path}: nothing can be made in the folder {parent} ({error.strerror or error}). Choose "
            "another place."
        ) from error
    if not (path.exists() or path.is_symlink()):
        return
    if path.is_dir() and not file and path.resolve() in (here := Path.cwd(), *here.parents):
        raise OutputError(f"{path} is the folder that you are in, or above it, and would be replaced. Name a new one.")
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OutputError(f"{path} is a device or a pipe, not a file. Pass a file name; --json - is standard output.")
    if file and path.is_dir():
        raise OutputError(f"{path} is a folder. Pass the name of a file.")
    if not force:
        raise OutputError(f"{path} exists already. Pass --force to replace it, or choose another name.")
    if path.is_dir():
        foreign = sorted(entry.name for entry in path.iterdir() if not _RESULTS.fullmatch(entry.name))
        if foreign:
            raise OutputError(
                f"{path} holds {foreign[0]!r}, which groma did not write; --force does not replace such a folder. "
                "Choose another name."
            )


def work_folder(output: Path, ending: str = ".work") -> Path:
    """Return the folder of checkpoints beside a result, which is removed at the end.

    Raises
    ------
    OutputError
        If it holds files that groma did not write.
    """
    folder = output.with_name(output.name + ending)
    names = {entry.name for entry in folder.iterdir()} if folder.is_dir() else set()
    is_ours = next(folder.glob("**/lock"), None) is not None or names <= _JOURNAL
    if not is_ours or (folder.exists() and not folder.is_dir()):
        raise OutputError(
            f"{folder} is where finished work is kept until the end, and is none that groma made. Move it away, or "
            "choose another output."
        )
    return folder


@contextmanager
def atomic_output(path: Path, force: bool, workshop_in: Path | None = None) -> Iterator[Path]:
    """Yield a draft to write a file or folder to; it is renamed to ``path`` at the end, or removed after an error.

    It is in ``workshop_in`` (default: beside ``path``).
    """
    from groma.io.atomic import atomic_output as complete_or_not_at_all

    check_output(path, force)
    with complete_or_not_at_all(path, force, workshop_in) as draft:
        yield draft


def check_json(target: str | None, force: bool) -> None:
    """Refuse, before any work, a report that could not be written."""
    if target not in (None, "-"):
        check_output(Path(target), force, file=True)


def write_json(target: str | None, content: dict[str, object], force: bool = False) -> None:
    """Write ``content`` to the file ``target``, to standard output if it is '-', not at all if it is None."""
    if target is None:
        return
    text = json_text(content)
    if target == "-":
        print(text, end="", flush=True)
        return
    with atomic_output(Path(target), force) as draft:
        draft.write_text(text, encoding="utf-8")
