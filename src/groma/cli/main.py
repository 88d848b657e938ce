# SPDX-License-Identifier: BSD-3-Clause
"""The entry point: run the application, and leave at once after Ctrl-C.

Ctrl-C is answered from the first line of :func:`main` on, so this module imports only what Python has loaded anyhow.
Before that, while the interpreter starts and finds this file, Python answers.

Exit codes: 0 success, 1 a known error (one line on standard error), 2 wrong usage, 130 interrupted.
"""

import gc
import os
import sys
from io import TextIOWrapper

#: New objects after which garbage is looked for; Python's own number is 700. Modules are a hundred thousand that stay.
#: Cost: time only.
_COLLECT_AFTER = 50_000


def run(arguments: list[str] | None = None) -> int:
    """Run the command line with ``arguments`` (default: those of the process) and return the exit code."""
    from groma.cli.shared.interrupt import INTERRUPTED, PROCESS

    PROCESS.asked = PROCESS.told = False
    try:
        from groma.cli.app import app

        app(args=arguments, prog_name="groma")
    except SystemExit as exit_request:
        code = exit_request.code
        if code == INTERRUPTED and PROCESS.asked:
            PROCESS.tell()  # between the lines of the command line itself
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
                # A name that the terminal cannot show is shown by its numbers; it is no reason to end.
                stream.reconfigure(errors="backslashreplace")
        code = run()
        ignore_signals()
    except KeyboardInterrupt:  # before signals are answered, or a second time, while the first is answered
        from groma.cli.shared.interrupt import PROCESS

        code = PROCESS.tell()
    from groma.cli.shared.interrupt import INTERRUPTED

    if code == INTERRUPTED:
        # Worker threads may still be inside a compiled kernel; the normal exit would wait for them.
        sys.stderr.flush()
        os._exit(code)
    gc.freeze()  # memory goes back as a whole: no search for garbage in it
    sys.exit(code)


if __name__ == "__main__":
    main()
