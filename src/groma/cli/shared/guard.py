# SPDX-License-Identifier: BSD-3-Clause
"""Turn what a command raises into an exit code and one line; a traceback is only for errors of groma itself."""

import functools
import sys
import warnings
from collections.abc import Callable
from typing import ParamSpec

import typer

from groma.cli.shared.console import complain, warn
from groma.cli.shared.interrupt import PROCESS
from groma.errors import GromaError
from groma.plugins import load_plugins

P = ParamSpec("P")


def guard(command: Callable[P, None]) -> Callable[P, None]:
    """Wrap a command: known errors end in exit code 1 and one line, Ctrl-C in 130; warnings are lines, too."""

    @functools.wraps(command)
    def guarded(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            with warnings.catch_warnings():
                if not getattr(kwargs.get("console"), "quiet", False):
                    warnings.showwarning = _show
                    warnings.simplefilter("always", UserWarning)
                else:
                    warnings.simplefilter("ignore")
                load_plugins()
                if PROCESS.asked:  # while a plugin was imported, which is then said to be broken
                    raise KeyboardInterrupt
                command(*args, **kwargs)
            if sys.stdout is not None:  # a process may be started without one
                sys.stdout.flush()
        except BrokenPipeError:
            # The reader of a pipe has gone (``groma ... | head``). Nothing more can be said to it.
            sys.stdout = None  # type: ignore[assignment]
            raise typer.Exit(1) from None
        except (typer.Exit, typer.BadParameter):
            raise
        except (KeyboardInterrupt, Exception) as error:
            if isinstance(error, KeyboardInterrupt) or PROCESS.explains(error):
                raise typer.Exit(PROCESS.tell()) from None
            _explain(error)
            raise
        finally:
            if (ahead := sys.modules.get("groma.compilation.ahead")) is not None:
                ahead.end()

    return guarded


def _explain(error: Exception) -> None:
    """End with a line for an error that is known."""
    if isinstance(error, GromaError):
        _fail(str(error), 1)
    if isinstance(error, OSError):
        place = f"{error.filename}: " if error.filename else ""
        _fail(f"{place}{error.strerror or error}", 1)
    if isinstance(error, MemoryError):
        _fail("the memory of this machine is not enough for this input.", 1)


def _show(message: Warning | str, category: type[Warning], *_where: object) -> None:
    """Print a warning for the user as one line; others are for developers and stay silent."""
    if category is UserWarning:
        warn(str(message))


def _fail(message: str, code: int) -> None:
    from groma.solver.reduce.mpi import started_as

    if started_as()[0] == 0:  # of processes that mpiexec started together, the first speaks
        complain("groma:", " ".join(message.split()), "red")
    raise typer.Exit(code) from None
