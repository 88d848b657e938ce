# SPDX-License-Identifier: BSD-3-Clause
"""Deprecated functions: they work, warn once with the line of the caller, and leave in the version that was said."""

import importlib
import pkgutil
import sys
import warnings

import pytest

import groma
from groma import _deprecation


@pytest.fixture
def old_name(monkeypatch):
    monkeypatch.setattr(_deprecation, "DEPRECATED", {})

    @_deprecation.deprecated(since="0.2", removed_in="0.4", use="groma.new_name")
    def old_name(first, *, second=2):
        """Add two numbers.

        Slowly.
        """
        return first + second

    return old_name


def test_it_works_and_warns_once_with_the_line_of_the_caller(old_name):
    with pytest.warns(DeprecationWarning, match=r"since groma 0\.2 .* removed in 0\.4\. Use groma\.new_name\.") as said:
        line = sys._getframe().f_lineno + 1
        assert old_name(1, second=3) == 4
    assert [(found.filename, found.lineno) for found in said] == [(__file__, line)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert old_name(1) == 3


def test_name_and_documentation_stay_with_a_note(old_name):
    assert old_name.__name__ == "old_name"
    assert old_name.__doc__ == (
        "Add two numbers.\n\n.. deprecated:: 0.2\n   Will be removed in 0.4. Use groma.new_name.\n\nSlowly."
    )
    (removed_in,) = _deprecation.DEPRECATED.values()
    assert removed_in == "0.4"


def _numbers(version):
    return tuple(int(part) for part in version.split(".")[:2])


def _overdue(listed, version):
    return [name for name, removed_in in listed.items() if _numbers(removed_in) <= _numbers(version)]


def test_what_was_to_be_removed_is_not_there_any_more():
    for module in pkgutil.iter_modules(groma.__path__, "groma."):
        if module.name != "groma.__main__":
            importlib.import_module(module.name)
    assert not _overdue(_deprecation.DEPRECATED, groma.__version__)


def test_what_is_overdue_is_found():
    listed = {"early": "0.9", "now": "0.10", "later": "0.11", "much later": "1.0"}
    assert _overdue(listed, "0.10.3") == ["early", "now"]
