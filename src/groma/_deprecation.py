# SPDX-License-Identifier: BSD-3-Clause
"""Functions that go away: they work for a while, and say what to use instead.

In comes a function that is still there for those who call it; out comes one that warns the first caller, naming their
line, and a note in its documentation. ``DEPRECATED`` lists them, and a test fails when a release still has what it was
to be without.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import wraps
from inspect import cleandoc
from typing import ParamSpec, TypeVar

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

#: Qualified names of deprecated functions, and the version that is without them.
DEPRECATED: dict[str, str] = {}


def deprecated(
    *, since: str, removed_in: str, use: str
) -> Callable[[Callable[_Arguments, _Result]], Callable[_Arguments, _Result]]:
    """Return a decorator that marks a function as deprecated.

    Parameters
    ----------
    since : str
        First version that warns.
    removed_in : str
        First version without the function.
    use : str
        What to call instead, as a name or a short sentence.
    """

    def decorate(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
        name = f"{function.__module__}.{function.__qualname__}"
        DEPRECATED[name] = removed_in
        has_warned = False

        @wraps(function)
        def call(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
            nonlocal has_warned
            if not has_warned:
                has_warned = True
                said = f"{name} is deprecated since groma {since} and will be removed in {removed_in}. Use {use}."
                warnings.warn(said, DeprecationWarning, stacklevel=2)
            return function(*args, **kwargs)

        first, _, rest = cleandoc(function.__doc__ or "").partition("\n\n")
        note = f".. deprecated:: {since}\n   Will be removed in {removed_in}. Use {use}."
        call.__doc__ = "\n\n".join(part for part in (first, note, rest) if part)
        return call

    return decorate
