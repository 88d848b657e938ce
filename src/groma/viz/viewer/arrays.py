# SPDX-License-Identifier: BSD-3-Clause
"""Nodes that the pages of scenes and of running tracks share, and arrays as the page expects them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.io.drawn import light, typical_gap
from groma.scene.patches import PALETTE, patch_groups, triangle_fans
from groma.viz.colours import Colours
from groma.viz.viewer.content import REACH

if TYPE_CHECKING:
    import viser


def by_end(colours: Colours) -> Colours:
    """Return colours (L, 3) for both ends of segments, (L, 2, 3).

    The page takes the colours of segment ends, unlike all others, as linear intensities.
    """
    return np.repeat(np.round(255.0 * light(colours)).astype(np.uint8)[:, None], 2, axis=1)


def point_size(count: int) -> float:
    """Return the initial point size, smaller for more points."""
    return float(np.clip(np.round(2.0 * (4.0 + 2e4 / max(count, 1))) / 2.0, 4.0, 12.0))


def camera_scale(centers: FloatArray) -> float:
    """Return the size of drawn cameras at which neighbours do not overlap, within limits."""
    if len(centers) < 2:
        return 0.08 * REACH
    return float(np.clip(0.45 * typical_gap(centers), 0.02 * REACH, 0.12 * REACH))


def add_segments(
    server: viser.ViserServer, name: str, segments: FloatArray, colours: Colours, width: float, visible: bool = True
) -> Any:
    """Add segments (L, 2, 3) with colours (L, 3) or (3,), as wide on the screen as given."""
    ends = by_end(np.broadcast_to(colours, (len(segments), 3)))
    return server.scene.add_line_segments(
        name, segments.astype(np.float32), ends, thickness=width, thickness_units="screen", visible=visible
    )


def add_dots(
    server: viser.ViserServer,
    name: str,
    places: FloatArray,
    colours: Colours,
    size: float,
    visible: bool = True,
    shape: Literal["circle", "diamond"] = "circle",
) -> Any:
    """Add dots (N, 3) with colours (N, 3) or (3,), as large as given in the units of the page."""
    return server.scene.add_point_cloud(
        name, places.astype(np.float32), np.ascontiguousarray(np.broadcast_to(colours, places.shape), np.uint8),
        point_size=size, point_shape=shape, point_shading="flat", precision="float32", visible=visible,
    )  # fmt: skip


def add_patches(
    server: viser.ViserServer, name: str, patches: Sequence[FloatArray], members: IntArray, visible: bool = True
) -> list[Any]:
    """Add polygons, those of one colour as one object: hundreds of planes are then drawn quickly."""
    group, nodes = patch_groups(members) if patches else np.zeros(0, np.int64), []
    for colour in np.unique(group):
        vertices, faces = triangle_fans([patches[plane] for plane in np.flatnonzero(group == colour).tolist()])
        red, green, blue = (int(channel) for channel in PALETTE[colour])
        nodes.append(server.scene.add_mesh_simple(
            f"{name}/{colour}", vertices.astype(np.float32), faces.astype(np.uint32),
            color=(red, green, blue), opacity=0.28, side="double", flat_shading=True,
            cast_shadow=False, receive_shadow=False, visible=visible,
        ))  # fmt: skip
    return nodes
