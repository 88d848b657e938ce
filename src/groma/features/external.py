# SPDX-License-Identifier: BSD-3-Clause
"""Matches and segments made elsewhere, for example by a learned matcher, handed in as an ``.npz`` file.

The file holds, for every image pair, arrays named by the two image names joined with ``|``::

    segments|<image>            (N, 4) float  end points u1 v1 u2 v2, first pixel's centre at (0.5, 0.5); optional
    matches|<image>|<image>     (M, 2) int    segment index in the first and in the second image
    scores|<image>|<image>      (M,) float    0 to 1, higher is better; optional, 1 if absent

Nothing is unpickled. Either order of the two images will do when asking for a pair.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from groma.bounded.arrays import opened_arrays
from groma.errors import FileFormatError, GromaError, OutputError, check_kind
from groma.features.edge_fit import measure_edges
from groma.features.images import to_gray
from groma.features.matches import LineMatches
from groma.features.segments import Segments


@dataclass(frozen=True)
class ExternalMatches:
    """Segments and matches by image name."""

    #: End points (N, 4) by image name; empty where the file has matches only.
    segments: Mapping[str, npt.NDArray[np.float64]]
    #: Matches by pair of image names.
    matches: Mapping[tuple[str, str], LineMatches]

    def match(self, first: str, second: str) -> LineMatches:
        """Matches of a pair in the given order; none if the file has none."""
        if (first, second) in self.matches:
            return self.matches[first, second]
        if (second, first) in self.matches:
            return self.matches[second, first].swapped()
        return LineMatches.empty()

    def segments_of(self, name: str, image: npt.NDArray[np.generic]) -> Segments:
        """Segments of an image in the file's order, directed by the grey levels, with sigma and strength measured.

        An image the file does not name has none.
        """
        ends, sigma, strength = measure_edges(to_gray(image), self.segments.get(name, np.zeros((0, 4))), fit=False)
        return Segments(ends, sigma, strength)


def read_matches(path: str | Path) -> ExternalMatches:
    """Read an ``.npz`` file of matches (layout: see the module).

    Raises
    ------
    FileFormatError
        If the file is no such archive, or an array in it does not have the promised shape, type or range.
    """
    path = Path(path)
    segments: dict[str, npt.NDArray[np.float64]] = {}
    matches: dict[tuple[str, str], LineMatches] = {}
    arrays = _arrays(path)
    for key, array in arrays.items():
        kind, *names = key.split("|")
        if kind == "segments" and len(names) == 1:
            numeric = np.issubdtype(array.dtype, np.number) and not np.iscomplexobj(array)
            if array.ndim != 2 or array.shape[1] != 4 or not numeric or not np.isfinite(array).all():
                raise FileFormatError(f"{path}: '{key}' must be finite numbers of shape (N, 4); got {array.shape}.")
            segments[names[0]] = array.astype(np.float64)
        elif kind == "matches" and len(names) == 2:
            score = arrays.get("|".join(["scores", *names]), np.ones(len(array) if array.ndim else 0))
            try:
                matches[names[0], names[1]] = LineMatches(array, score)
            except (GromaError, ValueError, TypeError) as error:
                raise FileFormatError(f"{path}: '{key}': {error}") from error
        elif kind != "scores":
            raise FileFormatError(
                f"{path}: array '{key}' is none of segments|IMAGE, matches|IMAGE|IMAGE, scores|IMAGE|IMAGE. Rename it."
            )
    for (first, second), found in matches.items():
        limits = [len(segments[name]) if name in segments else np.iinfo(np.int64).max for name in (first, second)]
        try:
            found.check(limits[0], limits[1])
        except GromaError as error:
            raise FileFormatError(f"{path}: matches|{first}|{second}: {error}") from error
        if not (np.isfinite(found.score).all() and ((found.score >= 0.0) & (found.score <= 1.0)).all()):
            raise FileFormatError(f"{path}: scores|{first}|{second} must lie between 0 and 1.")
    return ExternalMatches(segments, matches)


def _arrays(path: Path) -> dict[str, Any]:
    """Arrays of an archive; FileFormatError if it is damaged."""
    try:
        with opened_arrays(path) as members:
            return {key: members.read(key) for key in members.names}
    except FileNotFoundError:
        raise FileFormatError(f"Expected an .npz file of line matches; {path} does not exist.") from None
    except FileFormatError as error:
        raise FileFormatError(f"{path}: {error}") from error
    except OSError as error:
        raise FileFormatError(f"{path} cannot be read: {error.strerror or error}.") from error
    except Exception as error:  # of zipfile and zlib, which have no common root
        raise FileFormatError(
            f"Expected an .npz file of line matches; {path} is another kind of file, or incomplete. Write it with "
            "numpy.savez, or groma.features.external.write_matches."
        ) from error


def write_matches(path: str | Path, external: ExternalMatches, force: bool = False) -> None:
    """Write segments and matches in the layout :func:`read_matches` reads, whole or not at all.

    Parameters
    ----------
    path : path
        Where the file goes.
    external : ExternalMatches
        Segments and matches.
    force : bool
        Replace what is there. Without it an existing file is refused.

    Raises
    ------
    OutputError
        If something is there and ``force`` is False, or if the file system refuses.
    """
    check_kind(external, ExternalMatches, "external", "Make one: ExternalMatches(segments, matches).")
    path = Path(path)
    if not force and (path.exists() or path.is_symlink()):
        raise OutputError(f"{path} exists already. Pass force=True to replace it, or choose another name.")
    arrays: dict[str, npt.NDArray[np.generic]] = {f"segments|{n}": np.asarray(e) for n, e in external.segments.items()}
    for (first, second), found in external.matches.items():
        arrays[f"matches|{first}|{second}"] = found.pairs
        arrays[f"scores|{first}|{second}"] = found.score
    try:
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as workshop:
            draft = Path(workshop) / "draft.npz"
            np.savez_compressed(draft, **arrays)  # pyright: ignore[reportArgumentType]
            os.replace(draft, path)
    except OSError as error:
        raise OutputError(f"Cannot write {path}: {error.strerror or error}. Choose another place.") from error
