# SPDX-License-Identifier: BSD-3-Clause
"""The errors of groma.

::

    GromaError
    ├── InputError (ValueError)      what the caller passed cannot be used
    │   ├── ShapeError               an array has the wrong shape
    │   ├── FileFormatError          a file is not what it claims to be: truncated, mutated, hostile
    │   └── ProblemError             variables and factors do not fit together
    └── OutputError (OSError)        a result could not be written

Every message has three parts: what was expected, what came, what to do next. Failing to converge is an outcome, not
an error: see :class:`groma.solver.termination.Termination`.
"""

import difflib
from collections.abc import Iterable, Iterator
from typing import TypeVar

_Options = TypeVar("_Options")


class GromaError(Exception):
    """Base class of the errors of groma."""


class InputError(GromaError, ValueError):
    """An argument is invalid."""


class ShapeError(InputError):
    """An array has the wrong shape."""


class FileFormatError(InputError):
    """A file violates its format."""


class ProblemError(InputError):
    """Variables and factors of a problem do not fit together."""


class OutputError(GromaError, OSError):
    """A result could not be written."""


def causes_of(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and what it came from."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def is_interrupt(error: BaseException) -> bool:
    """Whether an error came from Ctrl-C: a package that it ends the import of says that it cannot be imported."""
    return any(isinstance(one, KeyboardInterrupt) for one in causes_of(error))


def check_kind(value: object, kinds: type | tuple[type, ...], name: str, way: str) -> None:
    """Raise InputError unless the argument ``name`` is of a kind; ``way`` is a sentence that says how to get one."""
    if not isinstance(value, kinds):
        wanted = " or ".join(kind.__name__ for kind in (kinds if isinstance(kinds, tuple) else (kinds,)))
        article = "an" if wanted[0] in "AEIOUaeiou" else "a"
        raise InputError(f"{name} must be {article} {wanted}; got {type(value).__name__}. {way}")


def given_or_default(value: _Options | None, kind: type[_Options], name: str = "options") -> _Options:
    """Return options, by default those of their kind; raise InputError where they are of another one."""
    if value is None:
        return kind()
    check_kind(value, kind, name, f"Make one: {kind.__name__}(...), or leave it out.")
    return value


def require(condition: object, what: str, message: str) -> None:
    """Raise AssertionError where a check of :mod:`groma.testing` does not hold: of which part, and what came."""
    if not condition:
        raise AssertionError(f"{what}: {message}.")


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return the end of a message about a name that is not known: `` Did you mean 'huber'?``; empty if none is near."""
    by_key = {other.lower().replace("-", "_"): other for other in known}
    close = difflib.get_close_matches(name.lower().replace("-", "_"), by_key, n=1)
    return f" Did you mean {by_key[close[0]]!r}?" if close else ""
