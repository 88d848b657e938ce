# SPDX-License-Identifier: BSD-3-Clause
"""Photographs with points, and messages about their poses."""

from __future__ import annotations

from dataclasses import dataclass

from groma.scene import Scene


@dataclass(frozen=True, eq=False)
class RegisteredPhotographs:
    """A scene of photographs with points."""

    #: Poses, points, and given poses as measurements where there are any.
    scene: Scene
    #: What was found out, and what was wrong.
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
