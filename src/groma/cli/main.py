# SPDX-License-Identifier: BSD-3-Clause
"""The entry point: run the application, and leave at once after Ctrl-C.

Exit codes: 0 success, 1 a known error (one line on standard error), 2 wrong usage, 130 interrupted.
"""

import os
import sys

from groma.cli._interrupt import INTERRUPTED


def run(arguments: list[str] | None = None) -> int:
    """Run the command line with ``arguments`` (default: those of the process) and return the exit code."""
    try:
        from groma.cli.app import app

        app(args=arguments, prog_name="groma")
    except SystemExit as exit_request:
        code = exit_request.code
        return code if isinstance(code, int) else int(code is not None)
    except KeyboardInterrupt:
        sys.stderr.write("groma: interrupted; nothing was written.\n")
        return INTERRUPTED
    return 0


def main() -> None:
    """Run as a process."""
    code = run()
    if code == INTERRUPTED:
        # Worker threads may still be inside a compiled kernel; the normal exit would wait for them.
        sys.stderr.flush()
        os._exit(INTERRUPTED)
    sys.exit(code)


if __name__ == "__main__":
    main()
