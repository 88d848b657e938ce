# SPDX-License-Identifier: BSD-3-Clause
"""The command line: one file per command, each a thin door over a library function.

Nothing heavy is imported before a command runs: ``groma --help`` loads neither NumPy nor Numba.
"""
