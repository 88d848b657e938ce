# SPDX-License-Identifier: BSD-3-Clause
"""The scene: cameras, images, landmarks, observations and relations as plain arrays.

Nothing here computes; a scene is what files hold and what pipelines take and return. Tables refer to each other by
index (``*_idx``, from zero); identifiers (``ids``) are kept for files and people. A scene is valid once it exists:
all references are checked when it is made. Every change gives a new scene.

::

    rigs <- sensors -> cameras          frames -> rigs
    images -> cameras, frames, sensors
    point_observations -> images, points          keypoints -> images
    line_observations  -> images, lines           relations -> points, lines, planes, directions
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.errors import InputError, ShapeError
from groma.geometry import quaternion, se3
from groma.scene.camera import CAMERA, Cameras, Rigs, Sensors
from groma.scene.image import Frames, Images
from groma.scene.landmarks import Directions, Lines, Planes, Points
from groma.scene.observations import Keypoints, LineObservations, PointObservations, Relations
from groma.scene.similarity import Similarity
from groma.scene.table import check_index, rows_of

_QUATERNION_TOLERANCE = 1e-6
_IDENTITY = np.array([0, 0, 0, 1, 0, 0, 0.0])


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """Everything known about a scene; see the module. Compare scenes with :mod:`groma.scene.compare`."""

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
    #: Lines seen in images.
    line_observations: LineObservations = field(default_factory=LineObservations)
    #: Planes.
    planes: Planes = field(default_factory=Planes)
    #: Directions shared by lines.
    directions: Directions = field(default_factory=Directions)
    #: Which landmarks belong together.
    relations: Relations = field(default_factory=Relations)

    def __post_init__(self) -> None:
        num_rigs, num_cameras = len(self.rigs), len(self.cameras)
        check_index("sensors.rig_idx", self.sensors.rig_idx, num_rigs, "rigs")
        is_camera = self.sensors.kind == CAMERA
        check_index("sensors.camera_idx", self.sensors.camera_idx[is_camera], num_cameras, "cameras")
        check_index("frames.rig_idx", self.frames.rig_idx, num_rigs, "rigs")
        check_index("images.camera_idx", self.images.camera_idx, num_cameras, "cameras")
        check_index("images.frame_idx", self.images.frame_idx, len(self.frames), "frames")
        check_index("images.sensor_idx", self.images.sensor_idx, len(self.sensors), "sensors")
        _check_quaternions("frames.rig_from_world", self.frames.rig_from_world)
        _check_quaternions("sensors.cam_from_rig", self.sensors.cam_from_rig)
        if len(self.images):
            sensor = self.images.sensor_idx
            if (self.sensors.camera_idx[sensor] != self.images.camera_idx).any() or (~is_camera[sensor]).any():
                raise InputError("images.camera_idx must be the camera of the image's sensor. Correct one of the two.")
            if (self.sensors.rig_idx[sensor] != self.frames.rig_idx[self.images.frame_idx]).any():
                raise InputError("images.sensor_idx must be a sensor of the rig of the image's frame. Correct one.")
        sizes = {"image": len(self.images), "point": len(self.points), "line": len(self.lines)}
        sizes |= {"plane": len(self.planes), "direction": len(self.directions)}
        for name in ("point_observations", "line_observations", "keypoints"):
            table = getattr(self, name)
            for kind in ("image", "point", "line"):
                index = getattr(table, f"{kind}_idx", None)
                if index is not None:
                    check_index(f"{name}.{kind}_idx", index, sizes[kind], f"{kind}s")
        for item in fields(self.relations):
            first, second = item.name.replace("_along_", "_on_").split("_on_")
            pairs = getattr(self.relations, item.name)
            check_index(f"relations.{item.name}[:, 0]", pairs[:, 0], sizes[first], f"{first}s")
            check_index(f"relations.{item.name}[:, 1]", pairs[:, 1], sizes[second], f"{second}s")

    def __repr__(self) -> str:
        counts = [(name, getattr(self, f"num_{name}")) for name in ("images", "cameras", "points", "lines", "planes")]
        counts += [("directions", self.num_directions), ("observations", self.num_observations)]
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
        index = np.asarray(camera_idx, np.int64)
        every, count = np.arange(len(cameras)), len(names)
        sensors = Sensors(
            rig_idx=every,
            kind=np.full(len(cameras), CAMERA),
            sensor_ids=cameras.ids,
            camera_idx=every,
            cam_from_rig=np.tile(_IDENTITY, (len(cameras), 1)),
            is_reference=np.ones(len(cameras), int),
            has_pose=np.ones(len(cameras), int),
        )
        return cls(
            cameras=cameras,
            rigs=Rigs(cameras.ids),
            sensors=sensors,
            frames=Frames(np.arange(count) + 1, index, np.asarray(cam_from_world, float)),
            images=Images(np.arange(count) + 1, tuple(names), index, np.arange(count), index),
            **tables,
        )

    # Counts

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

    # Poses

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

    # New scenes

    def replace(self, **tables: Any) -> Self:
        """Return a copy with some tables replaced."""
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
                "Use with_rig_poses(rig_from_world, cam_from_rig)."
            )
        poses = np.asarray(cam_from_world, float)
        if poses.shape != (self.num_images, 7):
            raise ShapeError(f"cam_from_world must have shape ({self.num_images}, 7); got {poses.shape}.")
        rig_from_world = np.empty_like(self.frames.rig_from_world)
        rig_from_world[self.images.frame_idx] = poses
        return self.with_rig_poses(rig_from_world)

    def with_rig_poses(self, rig_from_world: npt.ArrayLike, cam_from_rig: npt.ArrayLike | None = None) -> Self:
        """Return the scene with new poses of its frames, (F, 7), and perhaps of its sensors, (S, 7)."""
        sensors = self.sensors if cam_from_rig is None else self.sensors.replace(cam_from_rig=cam_from_rig)
        return self.replace(frames=self.frames.replace(rig_from_world=rig_from_world), sensors=sensors)

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
        """Return the scene without lines, planes, directions and relations."""
        return self.replace(
            lines=Lines(),
            line_observations=LineObservations(),
            planes=Planes(),
            directions=Directions(),
            relations=Relations(),
        )

    def transformed(self, new_from_old: Similarity | FloatArray) -> Self:
        """Return the scene seen from another world frame; what the cameras see stays the same.

        Lengths in the camera and rig frames are scaled too, so that reprojections do not change. A similarity may be
        given as an array (8,) of :mod:`groma.geometry.sim3`, too.
        """
        if not isinstance(new_from_old, Similarity):
            new_from_old = Similarity.from_array(new_from_old)
        mounted = self.sensors.cam_from_rig.copy()
        mounted[:, 4:] *= new_from_old.scale
        lines = self.lines.replace(
            plucker=new_from_old.lines(self.lines.plucker), segments=new_from_old.points(self.lines.segments)
        )
        return self.replace(
            frames=self.frames.replace(rig_from_world=new_from_old.poses(self.frames.rig_from_world)),
            sensors=self.sensors.replace(cam_from_rig=mounted),
            points=self.points.replace(xyz=new_from_old.points(self.points.xyz)),
            lines=lines,
            planes=self.planes.replace(hesse=new_from_old.planes(self.planes.hesse)),
            directions=self.directions.replace(vectors=new_from_old.directions(self.directions.vectors)),
        )

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
        new_image = _new_index(chosen, self.num_images)
        kept_frames, frame_idx = np.unique(self.images.frame_idx[chosen], return_inverse=True)
        seen = self.replace(
            frames=self.frames.take(kept_frames),
            images=self.images.take(chosen).replace(frame_idx=frame_idx),
            point_observations=_renumbered(self.point_observations, image_idx=new_image),
            keypoints=_renumbered(self.keypoints, image_idx=new_image),
            line_observations=_renumbered(self.line_observations, image_idx=new_image),
        )
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
    ) -> Self:
        """Return the scene with some of its landmarks, what was observed of them, and the relations among them.

        Parameters
        ----------
        points, lines, planes, directions : (n,) int or (P,), (L,), (K,), (D,) bool, optional
            Which to keep, integers in their new order; all of a kind that is left out.
        """
        chosen = {"point": points, "line": lines, "plane": planes, "direction": directions}
        new, tables = {}, {}
        for kind, rows in chosen.items():
            table = getattr(self, f"{kind}s")
            new[kind] = np.arange(len(table))
            if rows is not None:
                kept = rows_of(f"{kind}s", rows, len(table), f"{kind}s")
                new[kind], tables[f"{kind}s"] = _new_index(kept, len(table)), table.take(kept)
        for kind in {"point", "line"} & {name.removesuffix("s") for name in tables}:
            seen = getattr(self, f"{kind}_observations")
            tables[f"{kind}_observations"] = _renumbered(seen, **{f"{kind}_idx": new[kind]})
        relations = {}
        for item in fields(self.relations):
            first, second = item.name.replace("_along_", "_on_").split("_on_")
            pairs = getattr(self.relations, item.name)
            pairs = np.column_stack([new[first][pairs[:, 0]], new[second][pairs[:, 1]]])
            relations[item.name] = pairs[(pairs >= 0).all(axis=1)]
        return self.replace(**tables, relations=Relations(**relations))


def _new_index(kept: IntArray, size: int) -> IntArray:
    index = np.full(size, -1, np.int64)
    index[kept] = np.arange(len(kept))
    return index


def _renumbered(table: Any, **new_index: IntArray) -> Any:
    columns = {name: index[getattr(table, name)] for name, index in new_index.items()}
    kept = np.all([column >= 0 for column in columns.values()], axis=0)
    return table.replace(**columns).take(kept)


def _check_quaternions(name: str, poses: FloatArray) -> None:
    if len(poses) == 0:
        return
    with np.errstate(over="ignore"):
        deviation = np.abs(np.einsum("ij,ij->i", poses[:, :4], poses[:, :4]) - 1)
    if deviation.max() > 2 * _QUATERNION_TOLERANCE:
        row = int(deviation.argmax())
        raise InputError(
            f"{name} must begin with a unit quaternion [qx qy qz qw]; row {row} has {poses[row, :4].tolist()}. "
            "Divide it by its length."
        )
