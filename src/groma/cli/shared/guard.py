# SPDX-License-Identifier: BSD-3-Clause
"""Exceptions of a command as an exit code and one line; only bugs of groma give a traceback."""

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
    """Wrap a command: known errors give exit code 1 and one line, Ctrl-C 130; warnings are printed as lines."""

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
                if PROCESS.asked:  # during the import of a plugin, which is then reported as broken
                    raise KeyboardInterrupt
                command(*args, **kwargs)
            if sys.stdout is not None:  # a process may be started without one
                sys.stdout.flush()
        except BrokenPipeError:
            # The reader of the pipe has ended (``groma ... | head``).
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
    """Exit with one line if the error is a known one."""
    if isinstance(error, GromaError):
        _fail(str(error))
    if isinstance(error, OSError):
        place = f"{error.filename}: " if error.filename else ""
        _fail(f"{place}{error.strerror or error}")
    if isinstance(error, MemoryError):
        _fail("the memory of this machine is not enough for this input.")


def _show(message: Warning | str, category: type[Warning], *_where: object) -> None:
    """Print warnings for the user as one line; those for developers are dropped."""
    if category is UserWarning:
        warn(str(message))


def _fail(message: str) -> None:
    from groma.solver.reduce.mpi import started_as

    if started_as()[0] == 0:  # of the ranks of MPI only the first prints
        complain("groma:", " ".join(message.split()), "red")
    raise typer.Exit(1) from None
