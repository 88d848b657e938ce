# SPDX-License-Identifier: BSD-3-Clause
"""Compiled functions: how far they are compiled (``inner``), where they lie on disk (``cache``), how they are loaded
(``loading``), what their validity depends on (``digest``, ``parts``), and which process compiles them (``turns``).

In come Numba's dispatchers, from the decorators in :mod:`groma._numba`; out come the same, which find on disk what was
compiled before.
"""
