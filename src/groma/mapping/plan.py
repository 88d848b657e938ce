# SPDX-License-Identifier: BSD-3-Clause
"""The stages of a map before it starts: the names with which its progress will be called, in order.

Stages whose results are kept from an earlier run are passed over, and the lines are mapped again, from ``adjusting
points and lines`` on, while that moves the poses.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from groma.mapping.options import MapOptions

#: Initial data of a map: photographs alone, poses without points, or a model of both.
Start = Literal["photographs", "poses", "model"]
_POINTS = ("finding points in images", "matching points of image pairs")
_STARTS: dict[Start, tuple[str, ...]] = {
    "photographs": (*_POINTS, "placing cameras"),
    "poses": (*_POINTS, "placing points at the poses"),
    "model": (),
}
_LINES = ("proposing lines", "linking segments")
_STRUCTURE = ("finding planes", "finding directions", "finding relations")


def planned_stages(
    options: MapOptions,
    start: Start = "photographs",
    surveyed: bool = False,
    given_segments: bool = False,
    depth: bool = False,
) -> tuple[str, ...]:
    """Return the names of the stages of :func:`groma.map_images`.

    Parameters
    ----------
    options : MapOptions
        Of the map.
    start : str
        Initial data.
    surveyed : bool
        Positions, control points or distances take part.
    given_segments : bool
        Segments come from elsewhere.
    depth : bool
        There are depth maps.
    """
    rolling = options.rolling_shutter is not None
    return (
        "checking images",
        *_STARTS[start],
        "adjusting points and motions" if rolling else "adjusting points",
        *(("measuring points", "adjusting points again") if options.refine_points else ()),
        *(("adjusting with measurements",) if surveyed else ()),
        *(("reading depths of points", "adjusting with depths") if depth else ()),
        "reading segments" if given_segments else "finding segments",
        *(("reading depths of segments",) if depth else ()),
        *_LINES,
        *(("adjusting points and lines", *_LINES) if options.refine_poses else ()),
        *(_STRUCTURE if options.find_planes else ()),
        "adjusting everything",
        *(("adjusting with motions",) if rolling else ()),
    )
