# SPDX-License-Identifier: BSD-3-Clause
"""The public names: ``__all__`` is sorted, complete, and every name can be loaded."""

import ast
import inspect
from pathlib import Path

import pytest

import groma


def test_all_is_sorted_without_repetition():
    assert groma.__all__ == sorted(set(groma.__all__))


def test_all_equals_the_lazy_names():
    assert set(groma.__all__) == set(groma._HOME) | set(groma._SUBPACKAGES)


@pytest.mark.parametrize("name", groma.__all__)
def test_name_can_be_loaded(name):
    assert getattr(groma, name) is not None
    assert name in dir(groma)


def test_type_checkers_see_the_same_names():
    tree = ast.parse(Path(inspect.getfile(groma)).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    imported = {alias.asname or alias.name for node in block.body for alias in node.names}
    assert imported == set(groma.__all__)


def test_unknown_name_is_an_attribute_error_that_helps():
    with pytest.raises(AttributeError, match=r"no attribute 'adjsut'.*adjust"):
        _ = groma.adjsut
