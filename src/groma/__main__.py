# SPDX-License-Identifier: BSD-3-Clause
"""``python -m groma`` does what the command ``groma`` does."""

from groma.cli.main import main

if __name__ == "__main__":
    main()
