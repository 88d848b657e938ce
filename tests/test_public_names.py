# SPDX-License-Identifier: BSD-3-Clause
"""The public names: ``__all__`` is sorted, complete, and every name can be loaded.

The supported names, of all rooms: each exists and says what it is, and the page that lists them is up to date.
"""

import ast
import importlib
import inspect
import runpy
from pathlib import Path

import pytest

import groma


def test_all_is_sorted_without_repetition():
    assert groma.__all__ == sorted(set(groma.__all__))


def test_all_equals_the_lazy_names():
    assert set(groma._HOME) <= set(groma.__all__)
    for name in set(groma.__all__) - set(groma._HOME):
        assert inspect.ismodule(getattr(groma, name))


@pytest.mark.parametrize("name", groma.__all__)
def test_name_can_be_loaded(name):
    assert getattr(groma, name) is not None
    assert name in dir(groma)


def test_type_checkers_see_the_same_names():
    tree = ast.parse(Path(inspect.getfile(groma)).with_suffix(".pyi").read_text(encoding="utf-8"))
    seen = {alias.asname for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    seen |= {node.targets[0].id for node in tree.body if isinstance(node, ast.Assign)}
    assert seen - {None, "__version__"} == set(groma.__all__)


def test_unknown_name_is_an_attribute_error_that_helps():
    with pytest.raises(AttributeError, match=r"no attribute 'adjsut'.*adjust"):
        _ = groma.adjsut


SUPPORTED_NAMES = runpy.run_path(str(Path(__file__).resolve().parents[1] / "docs" / "_supported_names.py"))


@pytest.mark.parametrize(("module", "names"), SUPPORTED_NAMES["supported"]().items(), ids=lambda value: str(value)[:40])
def test_supported_names_exist_and_say_what_they_are(module, names):
    assert names
    for name in names:
        assert not name.startswith("_")
        value = getattr(importlib.import_module(module), name)
        if inspect.isclass(value) or inspect.isfunction(value):
            assert inspect.getdoc(value), f"{module}.{name} has no docstring"


def test_the_page_of_supported_names_is_up_to_date():
    """``python docs/_supported_names.py`` writes it anew."""
    assert SUPPORTED_NAMES["PAGE"].read_text(encoding="utf-8") == SUPPORTED_NAMES["page"]()


def test_top_level_names_are_supported():
    assert set(SUPPORTED_NAMES["supported"]()["groma"]) == set(groma.__all__) - set(groma._SUBPACKAGES)
