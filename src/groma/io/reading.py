# SPDX-License-Identifier: BSD-3-Clause
"""One place where everything that can go wrong while reading a file becomes an error of groma."""

import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from groma._counted import counted
from groma.errors import FileFormatError, GromaError, InputError


@contextmanager
def reading(path: str | os.PathLike[str], kind: str) -> Iterator[None]:
    """Turn whatever a parser raises on a damaged file into :class:`~groma.errors.FileFormatError`.

    Parsers raise many kinds of exceptions on damaged files (of zipfile, bz2, zlib, NumPy, struct, pycolmap). Missing
    files and missing permissions have messages of their own.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            yield
    except FileFormatError as error:
        if str(path) in str(error):
            raise
        raise FileFormatError(f"{path}: {error}") from error
    except GromaError as error:
        raise FileFormatError(f"{path} is not a usable {kind}: {error}") from error
    except IsADirectoryError as error:
        raise InputError(f"Cannot read {error.filename or path}: it is a folder. Pass the file in it.") from error
    except (FileNotFoundError, PermissionError, NotADirectoryError) as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}. Check the path.") from error
    except MemoryError as error:
        raise FileFormatError(f"{path} is too large for the memory of this machine, or damaged.") from error
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path} is not a usable {kind}: it is not a text file. Check the path.") from error
    except Exception as error:
        reason = str(error).strip() or type(error).__name__
        raise FileFormatError(
            f"{path} is not a usable {kind}; it may be damaged or incomplete ({reason.rstrip('.')}). Fetch or write it "
            "again."
        ) from error


def warn_of_the_others(path: str | os.PathLike[str], num_images: Sequence[int], where: str = "") -> None:
    """Say that of several reconstructions the largest is read; ``num_images`` are those of each, ``where`` it lies."""
    largest, *others = sorted(num_images, reverse=True)
    if others:
        sizes = ", ".join([*(f"{count:,}" for count in others[:-1]), counted(others[-1], "images")])
        rest = f"the others ({sizes}) are" if len(others) > 1 else f"the other ({sizes}) is"
        warnings.warn(
            f"{path} holds {len(num_images)} reconstructions in frames of their own. The one with most images "
            f"({largest:,}{where}) is read, {rest} not.",
            stacklevel=3,
        )
