# SPDX-License-Identifier: BSD-3-Clause
"""The entry point: run the application, and leave at once after Ctrl-C.

Ctrl-C is handled from the first line of :func:`main` on, so this module imports only what Python has loaded already.
Before that, Python's own handler is in force.

Exit codes: 0 success, 1 a known error (one line on standard error), 2 wrong usage, 130 interrupted.
"""

import gc
import os
import sys
from io import TextIOWrapper

#: New objects between garbage collections (Python: 700); importing creates a hundred thousand that stay. Cost: time.
_COLLECT_AFTER = 200_000


def run(arguments: list[str] | None = None) -> int:
    """Run the command line with ``arguments`` (default: those of the process) and return the exit code."""
    from groma.cli.shared.interrupt import INTERRUPTED, PROCESS

    PROCESS.asked = PROCESS.told = PROCESS.regular = False
    try:
        from groma.cli.app import app

        app(args=arguments, prog_name="groma")
    except SystemExit as exit_request:
        code = exit_request.code
        if code == INTERRUPTED and PROCESS.asked:
            PROCESS.tell()  # interrupted within Typer
        return code if isinstance(code, int) else int(code is not None)
    except (KeyboardInterrupt, Exception) as error:
        if not (isinstance(error, KeyboardInterrupt) or PROCESS.explains(error)):
            raise
        return PROCESS.tell()
    return 0


def main() -> None:
    """Run as a process."""
    try:
        gc.set_threshold(_COLLECT_AFTER)
        from groma.cli.shared.interrupt import answer_signals, ignore_signals

        answer_signals()
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, TextIOWrapper):
                # Characters that the terminal cannot encode are escaped.
                stream.reconfigure(errors="backslashreplace")
        code = run()
        ignore_signals()
    except KeyboardInterrupt:  # before the handlers are installed, or while one runs
        from groma.cli.shared.interrupt import PROCESS

        code = PROCESS.tell()
    from groma.cli.shared.interrupt import INTERRUPTED

    if code == INTERRUPTED:
        # Worker threads may still be inside a compiled kernel; the normal exit would wait for them.
        sys.stderr.flush()
        os._exit(code)
    gc.freeze()  # the process ends: no garbage collection
    sys.exit(code)


if __name__ == "__main__":
    main()
