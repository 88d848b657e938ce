# SPDX-License-Identifier: BSD-3-Clause
"""A made scene with measurements of other instruments, whose truth and noise are known."""

from dataclasses import replace

import numpy as np

from groma.geometry import quaternion, se3
from groma.io.survey import ControlFile, CoordinateSystem, Places
from groma.scene import (
    CameraPoses,
    CameraPositions,
    ControlPoints,
    Distances,
    KnownDirections,
    KnownPlanes,
    Marks,
    Similarity,
)  # fmt: skip
from groma.scene.survey import CHECK, CONTROL, Kind, diagonal_covariance
from groma.scene.synthetic.noise import project_pinhole
from groma.scene.synthetic.scenes import holistic

#: Standard deviations: of positions and control points, of marks (pixels), of distances.
SIGMA, MARK_PX, SIGMA_DISTANCE = 0.02, 0.5, 0.005
#: A frame far from that of the truth.
ELSEWHERE = Similarity.from_array(np.array([0.5, -0.5, 0.5, 0.5, 40.0, -7.0, 3.0, 0.21]))


class Exact:
    """Noise of nothing."""

    def normal(self, size=None):
        """Return zeros."""
        return np.zeros(() if size is None else size)


def made(images=8, noise_px=0.5, seed=1):
    """Truth and start of points alone, in the frame and unit of the truth."""
    scene = holistic(images, noise_px=noise_px, seed=seed)
    return scene.truth.points_only(), scene.start.points_only()


def positions(truth, rng, sigma=SIGMA):
    """Measured positions of all cameras."""
    noise = rng.normal(size=(truth.num_images, 3)) * sigma
    xyz = truth.cam_centers_in_world + noise
    return CameraPositions(np.arange(truth.num_images), xyz, diagonal_covariance(np.full(xyz.shape, sigma)))


def control(truth, rng, count=6, checks=2, sigma=SIGMA):
    """The first points that many images see as control points, the last of them kept back; with their marks."""
    table = truth.point_observations
    seen = np.bincount(table.point_idx, minlength=truth.num_points)
    chosen = np.argsort(-seen, kind="stable")[:count]
    xyz = truth.points.xyz[chosen]
    measured = xyz + rng.normal(size=xyz.shape) * sigma
    role = np.where(np.arange(count) < count - checks, CONTROL, CHECK)
    names = tuple(f"p{row}" for row in range(count))
    points = ControlPoints(names, measured, measured, diagonal_covariance(np.full(xyz.shape, sigma)), role)
    rows = np.flatnonzero(np.isin(table.point_idx, chosen))
    point = np.array([int(np.flatnonzero(chosen == of)[0]) for of in table.point_idx[rows]])
    poses = truth.cam_from_world[table.image_idx[rows]]
    pixel = project_pinhole(truth.cameras.params[0], poses, xyz[point])[0] + rng.normal(size=(len(rows), 2)) * MARK_PX
    return points, Marks(table.image_idx[rows], point, pixel, np.full(len(rows), MARK_PX)), xyz


def distances(truth, xyz, rng, sigma=SIGMA_DISTANCE):
    """Distances between the first two control points, and between the first two cameras."""
    between = np.linalg.norm(xyz[1] - xyz[0]) + rng.normal() * sigma
    centers = truth.cam_centers_in_world
    apart = np.linalg.norm(centers[1] - centers[0]) + rng.normal() * sigma
    kinds, numbers = np.array([Kind.CONTROL_POINT, Kind.IMAGE]), np.array([between, apart])
    zero, one = np.zeros(2, int), np.ones(2, int)
    return Distances(kinds, zero, kinds, one, np.zeros((2, 3)), numbers, np.full(2, sigma))


def with_objects(truth, rng):
    """The scene with poses, gravity, heights, and what is known of its first line and plane if it has some."""
    count, down = truth.num_images, np.array([0.0, 0.0, -1.0])
    noise = rng.normal(size=(count, 6)) * np.repeat([SIGMA, 0.005], 3)
    poses = se3.compose(se3.inverse(se3.exp(noise)), truth.cam_from_world)
    covariance = np.diag(np.repeat([SIGMA, 0.005], 3) ** 2)
    seen = quaternion.rotate(truth.cam_from_world[:, :4], np.tile(down, (count, 1)))
    seen = quaternion.rotate(quaternion.exp(rng.normal(size=(count, 3)) * 0.01), seen)
    kinds, rows = [Kind.IMAGE] * count, list(range(count))
    vectors, places = np.tile(down, (count, 1)), truth.cam_centers_in_world
    hesse = np.column_stack([np.tile([0, 0, 1.0], (count, 1)), rng.normal(size=count) * SIGMA - places[:, 2]])
    planes = KnownPlanes(kinds, rows, places, hesse, np.full(count, SIGMA))
    if truth.num_lines and truth.num_planes:
        kinds, rows = [*kinds, Kind.LINE, Kind.PLANE], [*rows, 0, 0]
        known = np.stack([truth.lines.plucker[0, 3:], truth.planes.hesse[0, :3]])
        vectors, seen = np.concatenate([vectors, known]), np.concatenate([seen, known])
    gravity = KnownDirections(kinds, rows, vectors, seen, np.full(len(rows), 0.01))
    table = CameraPoses(np.arange(count), poses, np.tile(covariance, (count, 1, 1)))
    return truth.replace(camera_poses=table, known_directions=gravity, known_planes=planes)


def with_everything(truth, rng):
    """The scene with positions, control points and distances."""
    points, marks, xyz = control(truth, rng)
    return truth.replace(
        camera_positions=positions(truth, rng), control_points=points, marks=marks, distances=distances(truth, xyz, rng)
    )


def on_rigs(scene):
    """The same images, two by two on rigs whose second camera is displaced and turned."""
    from groma.scene import Frames, Images, Rigs, Sensors

    mounted = se3.exp(np.array([[0.3, -0.1, 0.05, 0.2, 0.1, -0.3]]))
    frames = scene.num_images // 2
    first = scene.cam_from_world[::2][:frames]
    sensors = Sensors(
        rig_idx=np.zeros(2, int), kind=np.repeat(scene.sensors.kind[:1], 2), sensor_ids=np.array([1, 2]),
        camera_idx=np.zeros(2, int), cam_from_rig=np.vstack([[0, 0, 0, 1, 0, 0, 0.0], mounted[0]]),
        is_reference=np.array([1, 0]), has_pose=np.ones(2, int),
    )  # fmt: skip
    rows = np.arange(2 * frames)
    images = Images(rows + 1, scene.images.names[: 2 * frames], np.zeros(2 * frames, int), rows // 2, rows % 2)
    return type(scene)(
        cameras=scene.cameras, rigs=Rigs(np.array([1])), sensors=sensors,
        frames=Frames(np.arange(frames) + 1, np.zeros(frames, int), first), images=images, points=scene.points,
    )  # fmt: skip


def places_of(names, xyz, sigma=SIGMA, system=""):
    """Places as a file has them."""
    return Places(tuple(names), xyz, np.full(xyz.shape, sigma), CoordinateSystem(system), "positions.csv")


def measured_positions(truth, rng, shift=0.0):
    """Measured positions of all cameras as a file has them."""
    return places_of(truth.images.names, positions(truth, rng).xyz + shift)


def control_file(truth, rng, normalized=False):
    """Control points as a file has them, and where they truly are."""
    points, marks, xyz = control(truth, rng)
    names = tuple(truth.images.names[row] for row in marks.image_idx)
    given = places_of(points.names, points.measured, np.nan)
    found = ControlFile(given, points.role == CHECK, names, marks.point_idx, marks.pixel, False)
    if normalized:
        size = np.array([truth.cameras.width[0], truth.cameras.height[0]], float)
        found = replace(found, pixels=(marks.pixel - size / 2) / size.max(), normalized=True)
    return found, xyz
