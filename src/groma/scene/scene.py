# SPDX-License-Identifier: BSD-3-Clause
"""The scene: cameras, images, landmarks, observations and relations as plain arrays.

Nothing here computes; a scene is what files hold and what pipelines take and return. Tables refer to each other by
index (``*_idx``, from zero); identifiers (``ids``) are kept for files and people. A scene is valid once it exists:
all references are checked when it is made. Every change gives a new scene.

::

    rigs <- sensors -> cameras          frames -> rigs
    images -> cameras, frames, sensors  principal_point_priors -> cameras
    point_observations -> images, points          keypoints -> images
    line_observations  -> images, lines           relations -> points, lines, planes, directions
    point_depths       -> images, points          right_columns -> point_observations
    plane_observations -> images, planes          line_depths   -> line_observations
    pose_priors        -> frames                  line_intervals -> lines
    camera_motions, camera_positions, camera_poses -> images    marks -> images, control_points
    distances, known_planes, known_directions, held -> any objects

Each column declares in its table what it refers to and how it changes when the world moves (see
:func:`groma.scene.table.column`); checks, selections and transforms here go by that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import Any, Self, TypeVar

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.errors import InputError, ShapeError
from groma.geometry import quaternion, se3
from groma.scene import survey
from groma.scene.camera import Cameras, PrincipalPointPriors, Rigs, Sensors
from groma.scene.counts import measurements_of
from groma.scene.image import Frames, Images
from groma.scene.landmarks import Directions, Lines, Planes, Points
from groma.scene.line_intervals import LineIntervals
from groma.scene.measurements import LineDepths, PlaneObservations, PointDepths, PosePriors, RightColumns
from groma.scene.motions import CameraMotions
from groma.scene.observations import Keypoints, LineObservations, PointObservations, Relations
from groma.scene.similarity import Similarity
from groma.scene.standing_alone import standing_alone
from groma.scene.table import moved_table, new_index_of, references, rows_of
from groma.scene.validity import check_scene

SomeScene = TypeVar("SomeScene", bound="Scene")
_IDENTITY = np.array([0, 0, 0, 1, 0, 0, 0.0])


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """A scene: tables of cameras, images, landmarks, observations and measurements."""

    #: Calibrations.
    cameras: Cameras = field(default_factory=Cameras)
    #: Bodies that carry sensors.
    rigs: Rigs = field(default_factory=Rigs)
    #: What is mounted on the rigs.
    sensors: Sensors = field(default_factory=Sensors)
    #: Rigs at one moment, with their poses.
    frames: Frames = field(default_factory=Frames)
    #: Images taken by the sensors of a frame.
    images: Images = field(default_factory=Images)
    #: 3D points.
    points: Points = field(default_factory=Points)
    #: Points seen in images.
    point_observations: PointObservations = field(default_factory=PointObservations)
    #: 2D points without a 3D point.
    keypoints: Keypoints = field(default_factory=Keypoints)
    #: 3D lines.
    lines: Lines = field(default_factory=Lines)
    #: Where along them lines are supported, of those that have gaps.
    line_intervals: LineIntervals = field(default_factory=LineIntervals)
    #: Lines seen in images.
    line_observations: LineObservations = field(default_factory=LineObservations)
    #: Planes.
    planes: Planes = field(default_factory=Planes)
    #: Directions shared by lines.
    directions: Directions = field(default_factory=Directions)
    #: Which landmarks belong together.
    relations: Relations = field(default_factory=Relations)
    #: Depths of points.
    point_depths: PointDepths = field(default_factory=PointDepths)
    #: Observed points in the right images of stereo pairs.
    right_columns: RightColumns = field(default_factory=RightColumns)
    #: Inverse depths of the ends of observed segments.
    line_depths: LineDepths = field(default_factory=LineDepths)
    #: Planes measured in the cameras.
    plane_observations: PlaneObservations = field(default_factory=PlaneObservations)
    #: Poses known beforehand.
    pose_priors: PosePriors = field(default_factory=PosePriors)
    #: Where principal points are expected, of cameras whose calibration was not given.
    principal_point_priors: PrincipalPointPriors = field(default_factory=PrincipalPointPriors)
    #: Images that were read row by row, and how their cameras moved meanwhile.
    camera_motions: CameraMotions = field(default_factory=CameraMotions)
    #: Measured places and poses of cameras.
    camera_positions: survey.CameraPositions = field(default_factory=survey.CameraPositions)
    camera_poses: survey.CameraPoses = field(default_factory=survey.CameraPoses)
    #: Control and check points, and where they are in the images.
    control_points: survey.ControlPoints = field(default_factory=survey.ControlPoints)
    marks: survey.Marks = field(default_factory=survey.Marks)
    #: What was measured of cameras, control points and landmarks; what keeps its place.
    distances: survey.Distances = field(default_factory=survey.Distances)
    known_planes: survey.KnownPlanes = field(default_factory=survey.KnownPlanes)
    known_directions: survey.KnownDirections = field(default_factory=survey.KnownDirections)
    held: survey.Held = field(default_factory=survey.Held)

    def __post_init__(self) -> None:
        check_scene(self)

    def __repr__(self) -> str:
        names = "images cameras points lines planes directions observations".split()
        counts = [*((name, getattr(self, f"num_{name}")) for name in names), *self.num_measurements.items()]
        return f"Scene({', '.join(f'{count:,} {name}' for name, count in counts if count) or 'empty'})"

    @classmethod
    def from_images(
        cls,
        cameras: Cameras,
        names: Sequence[str],
        camera_idx: npt.ArrayLike,
        cam_from_world: npt.ArrayLike,
        **tables: Any,
    ) -> Self:
        """Return a scene in which every image stands alone: one rig per camera, one frame per image.

        Parameters
        ----------
        cameras : Cameras
            Calibrations.
        names : sequence of N strings
            File names of the images; they get the identifiers 1, 2, ...
        camera_idx : (N,) int
            The camera of each image.
        cam_from_world : (N, 7) float
            Poses [qx qy qz qw tx ty tz].
        **tables
            Further tables of the scene, by field name.
        """
        return _nothing(cls).replace(**standing_alone(cameras, names, camera_idx, cam_from_world), **tables)

    @property
    def num_images(self) -> int:
        """Number of images."""
        return len(self.images)

    @property
    def num_cameras(self) -> int:
        """Number of calibrations."""
        return len(self.cameras)

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.frames)

    @property
    def num_points(self) -> int:
        """Number of points."""
        return len(self.points)

    @property
    def num_lines(self) -> int:
        """Number of lines."""
        return len(self.lines)

    @property
    def num_planes(self) -> int:
        """Number of planes."""
        return len(self.planes)

    @property
    def num_directions(self) -> int:
        """Number of shared directions."""
        return len(self.directions)

    @property
    def num_point_observations(self) -> int:
        """Number of point observations."""
        return len(self.point_observations)

    @property
    def num_line_observations(self) -> int:
        """Number of line observations."""
        return len(self.line_observations)

    @property
    def num_observations(self) -> int:
        """Number of observations of points and lines together."""
        return len(self.point_observations) + len(self.line_observations)

    @property
    def num_measurements(self) -> dict[str, int]:
        """Numbers of measurements besides those of points and lines in images, by kind; only kinds that there are."""
        return measurements_of(self)

    @property
    def is_metric(self) -> bool:
        """Whether measurements of the cameras determine the scale: depths, stereo pairs, planes."""
        return any(map(len, (self.point_depths, self.right_columns, self.line_depths, self.plane_observations)))

    @property
    def has_survey(self) -> bool:
        """Whether there are measurements of other instruments than the cameras, or something is held."""
        places = self.camera_positions, self.camera_poses, self.control_points, self.distances
        return self.is_tied or any(map(len, places))

    @property
    def is_surveyed(self) -> bool:
        """Whether measured cameras or control points determine the position and scale of the scene."""
        return len(self.camera_positions) + len(self.camera_poses) + int(self.control_points.is_control.sum()) > 1

    @property
    def is_tied(self) -> bool:
        """Whether measurements of other instruments, or held objects, refer to the frame of the scene."""
        return self.is_surveyed or any(map(len, (self.known_planes, self.known_directions, self.held)))

    @property
    def has_scale(self) -> bool:
        """Whether any measurement determines the scale."""
        return self.is_metric or self.is_surveyed or len(self.distances) > 0

    @property
    def cam_from_world(self) -> FloatArray:
        """(N, 7) poses of the images: ``cam_from_rig`` of the sensor after ``rig_from_world`` of the frame."""
        poses = self.frames.rig_from_world[self.images.frame_idx]
        mounted = self.sensors.cam_from_rig[self.images.sensor_idx]
        away = (mounted != _IDENTITY).any(1)
        if away.any():
            poses[away] = se3.compose(mounted[away], poses[away])
        return poses

    @property
    def cam_centers_in_world(self) -> FloatArray:
        r"""(N, 3) camera centres :math:`-R^\top t`."""
        poses = self.cam_from_world
        return -quaternion.rotate(quaternion.conjugate(poses[:, :4]), poses[:, 4:])

    @property
    def has_trivial_rigs(self) -> bool:
        """Whether every frame holds one image, taken by the reference sensor of its rig."""
        return len(self.frames) == len(self.images) and bool(
            np.array_equal(np.sort(self.images.frame_idx), np.arange(len(self.frames)))
            and (self.sensors.cam_from_rig[self.images.sensor_idx] == _IDENTITY).all()
        )

    def replace(self, **tables: Any) -> Self:
        """Return a copy with some tables replaced.

        Raises
        ------
        InputError
            If a table of observations gets another number of rows while measurements refer to the old ones.
        """
        for name, column, _, target in references(Scene):
            if target.endswith("_observations") and target in tables and name not in tables:
                before, after = len(getattr(self, target)), len(tables[target])
                if before != after and len(getattr(self, name)):
                    raise InputError(
                        f"{name}.{column} refers to the {before} rows of {target}; got {after} new ones. "
                        f"Use scene.keep({target}=rows), or replace {name} too."
                    )
        return replace(self, **tables)

    def with_poses(self, cam_from_world: npt.ArrayLike) -> Self:
        """Return the scene with new poses of its images, (N, 7).

        Raises
        ------
        InputError
            If frames hold several images, whose poses are not independent: use :meth:`with_rig_poses`.
        """
        if not self.has_trivial_rigs:
            raise InputError(
                "with_poses needs a scene in which each frame holds one image; this one has rigs. "
                "Use with_rig_poses(rig_from_world)."
            )
        rig_from_world, poses = np.empty_like(self.frames.rig_from_world), np.asarray(cam_from_world, float)
        if poses.shape != (self.num_images, 7):
            raise ShapeError(f"cam_from_world must have shape ({self.num_images}, 7); got {poses.shape}.")
        rig_from_world[self.images.frame_idx] = poses
        return self.with_rig_poses(rig_from_world)

    def with_rig_poses(self, rig_from_world: npt.ArrayLike) -> Self:
        """Return the scene with new poses of its frames, (F, 7)."""
        return self.replace(frames=self.frames.replace(rig_from_world=rig_from_world))

    def with_params(self, params: npt.ArrayLike) -> Self:
        """Return the scene with new camera parameters, (C, K)."""
        return self.replace(cameras=self.cameras.replace(params=params))

    def with_points(self, xyz: npt.ArrayLike) -> Self:
        """Return the scene with its points at new places, (P, 3)."""
        return self.replace(points=self.points.replace(xyz=xyz))

    def with_lines(self, plucker: npt.ArrayLike) -> Self:
        """Return the scene with its lines at new places, (L, 6) of any scale; end points follow as feet."""
        return self.replace(lines=self.lines.moved_to(plucker))

    def with_planes(self, hesse: npt.ArrayLike) -> Self:
        """Return the scene with new planes, (K, 4) of any scale but zero."""
        planes = np.asarray(hesse, float)
        length = np.linalg.norm(planes[..., :3], axis=-1, keepdims=True)
        if not (length > 0).all():
            raise InputError("The plane at infinity (zero normal) cannot be kept in a scene. Remove it first.")
        return self.replace(planes=self.planes.replace(hesse=planes / length))

    def points_only(self) -> Self:
        """Return the scene without lines, planes, directions, and what was measured of them."""
        return self.keep(lines=[], planes=[], directions=[])

    def transformed(self, new_from_old: Similarity | FloatArray, measured: bool = True) -> Self:
        """Return the scene seen from another world frame; what the cameras see stays the same.

        Lengths in camera and rig frames are scaled too. An array (8,) of :mod:`groma.geometry.sim3` will do as well.
        Without ``measured``, measurements of other instruments in the world are not transformed.
        """
        if not isinstance(new_from_old, Similarity):
            new_from_old = Similarity.from_array(new_from_old)
        tables = ((item.name, getattr(self, item.name)) for item in fields(self))
        return self.replace(**{name: moved_table(table, new_from_old, measured) for name, table in tables})

    def subset(self, image_idx: npt.ArrayLike, min_observations: int = 1) -> Self:
        """Return the scene of some images, with the points and lines that they see.

        Cameras and rigs that are no longer used stay; planes and directions stay; frames without images go.

        Parameters
        ----------
        image_idx : (n,) int or (N,) bool
            The images to keep, in their new order.
        min_observations : int
            Points and lines seen less often are dropped; 0 keeps all of them.
        """
        chosen = rows_of("image_idx", image_idx, self.num_images, "images")
        kept_frames, frame_idx = np.unique(self.images.frame_idx[chosen], return_inverse=True)
        images = self.images.take(chosen).replace(frame_idx=frame_idx)
        tables = {"frames": self.frames.take(kept_frames), "images": images}
        new_index = {
            "frames": new_index_of(kept_frames, self.num_frames),
            "images": new_index_of(chosen, self.num_images),
        }
        seen = self._with(tables, new_index)
        points = np.bincount(seen.point_observations.point_idx, minlength=self.num_points)
        lines = np.bincount(seen.line_observations.line_idx, minlength=self.num_lines)
        return seen.keep(points=points >= min_observations, lines=lines >= min_observations)

    def keep(
        self,
        *,
        points: npt.ArrayLike | None = None,
        lines: npt.ArrayLike | None = None,
        planes: npt.ArrayLike | None = None,
        directions: npt.ArrayLike | None = None,
        point_observations: npt.ArrayLike | None = None,
        line_observations: npt.ArrayLike | None = None,
    ) -> Self:
        """Return the scene with some of its landmarks or observations, what was measured of them, and their relations.

        Parameters
        ----------
        points, lines, planes, directions : (n,) int or (P,), (L,), (K,), (D,) bool, optional
            Which to keep, integers in their new order; all of a kind that is left out.
        point_observations, line_observations : (n,) int or (N,) bool, optional
            Which to keep of the observations; those of landmarks that go, go anyhow.
        """
        chosen = {"points": points, "lines": lines, "planes": planes, "directions": directions}
        chosen |= {"point_observations": point_observations, "line_observations": line_observations}
        tables, new_index = {}, {}
        for name, rows in chosen.items():
            if rows is not None:
                table = getattr(self, name)
                kept = rows_of(name, rows, len(table), name.replace("_", " "))
                tables[name], new_index[name] = table.take(kept), new_index_of(kept, len(table))
        return self._with(tables, new_index)

    def _with(self, tables: dict[str, Any], new_index: dict[str, IntArray]) -> Self:
        """Return the scene with new tables, and all others renumbered; fields come before those that refer to them."""
        given = tables.keys() & {"frames", "images"}
        for name in [item.name for item in fields(self) if item.name not in given]:
            before = tables.get(name, getattr(self, name))
            table, kept = before.renumbered(new_index)
            if table is not before:
                tables[name] = table
            if kept is not None:
                first = new_index.get(name, np.arange(len(before)))
                new_index[name] = np.append(new_index_of(kept, len(before)), -1)[first]
        return self.replace(**tables)


@cache
def _nothing(kind: type[SomeScene]) -> SomeScene:
    """Return a scene without anything; many small scenes share its tables."""
    return kind()
