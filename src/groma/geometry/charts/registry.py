# SPDX-License-Identifier: BSD-3-Clause
"""All charts by kind of variable and name."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TypeVar

from groma.errors import InputError
from groma.geometry.manifold import Manifold

_C = TypeVar("_C", bound=Manifold | type[Manifold])
_CHARTS: dict[str, dict[str, Manifold]] = {}


def register_chart(chart: _C) -> _C:
    """Make a chart known by its ``kind`` and ``name``; a decorator of classes that need no arguments.

    Options such as :attr:`groma.AdjustOptions.line_chart` then take the name, and the conformance tests of factors try
    the chart. The first chart of a kind is its default.

    Raises
    ------
    InputError
        If the name belongs to a chart of another module.
    """
    made = chart() if isinstance(chart, type) else chart
    charts = _CHARTS.setdefault(made.kind, {})
    known = type(charts.get(made.name, made))
    if known.__module__ != type(made).__module__:
        raise InputError(
            f"A chart of kind {made.kind!r} named {made.name!r} is registered already, by {known.__module__}. "
            "Choose another name."
        )
    charts[made.name] = made
    return chart


def charts_of(kind: str) -> Mapping[str, Manifold]:
    """Return the charts of a kind by name, the default first; none for kinds of any size.

    The mapping is a view: charts that are registered later are in it too.
    """
    return MappingProxyType(_CHARTS.setdefault(kind, {}))
