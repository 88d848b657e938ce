# SPDX-License-Identifier: BSD-3-Clause
"""What is wrong with an input at first sight: said before the libraries that would read it are loaded."""

from pathlib import Path

from groma.errors import InputError


def whole_scene(source: Path) -> Path:
    """Return the archive in the folder of a map or track (it holds more than the COLMAP model there), or the source."""
    archive = source / "scene.npz"
    return archive if archive.is_file() and (source / "summary.json").is_file() else source


def check_inputs(*paths: Path | None) -> None:
    """Refuse places where there is nothing; None stands for an input that was not given."""
    for path in paths:
        if path is None:
            continue
        try:
            path.stat()
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise InputError(f"Cannot read {path}: {reason}. Check the path.") from error
