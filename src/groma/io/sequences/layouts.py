# SPDX-License-Identifier: BSD-3-Clause
"""The registry of sequence layouts: how each is recognised and opened."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from groma.errors import InputError, check_kind
from groma.io.sequences._calibration import Calibration
from groma.io.sequences._reader import Selection
from groma.io.sequences.frame import Sequence


@dataclass(frozen=True)
class Wishes:
    """Arguments of :func:`groma.io.sequences.open_sequence`."""

    #: Overrides the camera of the folder.
    calibration: Calibration | None
    #: Depth values per metre, overriding those of the layout.
    depth_scale: float | None
    #: Which frames, and of what kind.
    selection: Selection


@dataclass(frozen=True)
class SequenceLayout:
    """How sequences of one kind lie on disk."""

    name: str
    #: Recognised files, for messages: ``image_0 (KITTI)``.
    sign: str
    #: Returns what to open (the path itself, or a folder in it) if a path has this layout; else None.
    find: Callable[[Path], Path | None]
    #: Opens what was found.
    open: Callable[[Path, Wishes], Sequence]


_LAYOUTS: dict[str, SequenceLayout] = {}


def register_layout(layout: SequenceLayout) -> SequenceLayout:
    """Make a layout known to :func:`groma.io.sequences.open_sequence`; return it. Layouts are tried in order.

    Raises
    ------
    InputError
        If the name belongs to another layout.
    """
    check_kind(layout, SequenceLayout, "layout", "Make one: SequenceLayout(...).")
    known = _LAYOUTS.get(layout.name, layout)
    if known.open.__module__ != layout.open.__module__:
        raise InputError(f"A sequence layout named {layout.name!r} is registered already. Choose another name.")
    _LAYOUTS[layout.name] = layout
    return layout


def layouts() -> tuple[SequenceLayout, ...]:
    """All layouts, in the order in which they are tried."""
    return tuple(_LAYOUTS.values())
