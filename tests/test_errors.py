# SPDX-License-Identifier: BSD-3-Clause
"""Errors that were interrupts on their way, and errors that were not."""

from groma.errors import is_interrupt


def raised(*kinds):
    """Return an error that came of others, the first of them first."""
    try:
        try:
            raise kinds[0]
        except BaseException as first:
            for kind in kinds[1:]:
                error = kind("it cannot be imported")
                error.__cause__ = first
                first = error
            raise first from first.__cause__
    except BaseException as last:
        return last


def test_an_interrupted_import_is_an_interrupt():
    assert is_interrupt(raised(KeyboardInterrupt))
    assert is_interrupt(raised(KeyboardInterrupt, ImportError, RuntimeError))
    assert not is_interrupt(raised(ImportError, RuntimeError))
