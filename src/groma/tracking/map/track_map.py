# SPDX-License-Identifier: BSD-3-Clause
"""The map of a track: landmarks, keyframes, and which keyframes see the same."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.geometry import se3
from groma.tracking.frame.features import Features
from groma.tracking.frame.measurements import Measurements
from groma.tracking.map.landmarks import DEAD, LineTable, PlaneTable, PointTable


def in_unit(motion: FloatArray, unit: float) -> FloatArray:
    """Return a motion (7,) whose translation was in another unit of length, in that of the world."""
    return np.concatenate([motion[:4], unit * motion[4:]])


@dataclass(eq=False)
class Keyframe:
    """A frame that is kept: its image for patches, its measurements, and its described features."""

    index: int
    timestamp: float
    name: str
    #: (7,) cam_from_world.
    pose: FloatArray
    gray: npt.NDArray[np.uint8] | None
    measured: Measurements
    features: Features
    #: Depths on a grid of pixels; NaN where unknown.
    depth_grid: FloatArray
    #: Median depth of its points, scene units.
    depth: float = 1.0
    #: False once it is redundant; its pose is then relative to another keyframe.
    alive: bool = True
    parent: int = -1
    from_parent: FloatArray | None = None
    #: Length, in the world as it is now, of the unit in which the camera moved when the keyframe was made: loops and
    #: joints of maps of a single camera change it.
    unit: float = 1.0

    def forget(self) -> None:
        """Let go of everything but the pose."""
        self.gray = None
        self.measured = Measurements.empty()
        self.features = Features.none()
        self.depth_grid = np.full(len(self.depth_grid), np.nan)


@dataclass
class TrackMap:
    """The map of a track. It is mutable."""

    points: PointTable = field(default_factory=PointTable)
    lines: LineTable = field(default_factory=LineTable)
    planes: PlaneTable = field(default_factory=PlaneTable)
    keyframes: list[Keyframe] = field(default_factory=list)
    #: Pairs of keyframes joined by loop closures, with the measured first_from_second (8,): a similarity.
    loops: list[tuple[int, int, FloatArray]] = field(default_factory=list)
    #: The keyframe whose patches are followed: the newest, or an older one that was visited again.
    reference: int = -1
    #: Keyframes that must not be dropped: they join maps.
    pinned: set[int] = field(default_factory=set)

    @property
    def last(self) -> Keyframe:
        """The newest keyframe."""
        return self.keyframes[-1]

    @property
    def near(self) -> Keyframe:
        """The keyframe whose patches are followed."""
        return self.keyframes[self.reference]

    @property
    def is_metric(self) -> bool:
        """Whether depths or right images give it its scale."""
        return any(
            np.isfinite(k.measured.points.depth).any()
            or np.isfinite(k.measured.points.right[:, 0]).any()
            or len(k.measured.planes)
            for k in self.keyframes
        )

    def copy(self) -> TrackMap:
        """Return a map that can be changed without changing this one; images and other values are shared."""
        tables = {kind: getattr(self, kind).copy() for kind in ("points", "lines", "planes")}
        keyframes = [replace(keyframe, pose=keyframe.pose.copy()) for keyframe in self.keyframes]
        return replace(self, keyframes=keyframes, loops=list(self.loops), pinned=set(self.pinned), **tables)

    def visit(self, keyframe: Keyframe) -> None:
        """Follow the patches of a keyframe from now on."""
        self.reference = keyframe.index
        table = keyframe.measured.points
        self.points.keyframe[table.index], self.points.pixel[table.index] = keyframe.index, table.pixel

    def living(self) -> list[Keyframe]:
        """Keyframes that were not dropped, oldest first."""
        return [keyframe for keyframe in self.keyframes if keyframe.alive]

    def pose_of(self, index: int) -> FloatArray:
        """Pose (7,) of a keyframe, also of one that was dropped."""
        keyframe = self.keyframes[index]
        if keyframe.from_parent is None:
            return keyframe.pose
        return se3.compose(
            in_unit(keyframe.from_parent, self.unit_of(index))[None], self.pose_of(keyframe.parent)[None]
        )[0]

    def unit_of(self, index: int) -> float:
        """Unit of a keyframe; of a dropped one, that of the keyframe to which its pose refers."""
        keyframe = self.keyframes[index]
        return keyframe.unit if keyframe.from_parent is None else self.unit_of(keyframe.parent)

    def shared(self, keyframe: Keyframe, others: list[Keyframe]) -> IntArray:
        """How much each of the others sees of what a keyframe sees: points, and lines counted thrice."""
        seen = np.zeros(len(self.points), dtype=bool)
        seen[keyframe.measured.points.index] = True
        lines = np.zeros(len(self.lines), dtype=bool)
        lines[keyframe.measured.lines.index] = True
        return np.array(
            [
                int(seen[other.measured.points.index].sum()) + 3 * int(lines[other.measured.lines.index].sum())
                for other in others
            ],
            dtype=np.int64,
        )

    def drop_points(self, rows: IntArray) -> None:
        """Take points out of the map; measurements of them stay in tables and are ignored."""
        self.points.state[rows] = DEAD

    def drop_lines(self, rows: IntArray) -> None:
        """Take lines out of the map."""
        self.lines.state[rows] = DEAD
