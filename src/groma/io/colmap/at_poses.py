# SPDX-License-Identifier: BSD-3-Clause
"""Points of photographs whose poses are known more or less, by pycolmap: matches, two-view geometries, triangulation.

Features and matches do not depend on the poses, except for which pairs of many images are matched. They are kept in a
database as in :mod:`groma.io.colmap.sfm`, and finished work is not repeated.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from groma import cameras as camera_models
from groma._typing import FloatArray
from groma.geometry import quaternion
from groma.io.colmap.load import load_pycolmap, opened, quiet
from groma.io.colmap.model import from_pycolmap, to_pycolmap
from groma.io.colmap.pairs import blocks_of_pairs
from groma.io.colmap.sfm import PointModelOptions, Progress, check_room, explained, find_features, match_pairs
from groma.scene import PosePriors, Scene

#: Matches that a pair of images, or an image and a map, must agree on: COLMAP's numbers (convention: as in COLMAP).
MIN_MATCHES = 15


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """Two images, their matches, and the relative pose estimated from them."""

    #: Rows of the images.
    first: int
    second: int
    #: (M, 3) unit rays of the matches in the two cameras.
    first_rays: FloatArray
    second_rays: FloatArray
    #: (7,) pose of the first camera in the second, with a translation of length one.
    second_from_first: FloatArray
    #: Pixels per radian, of the two cameras together.
    focal: float


@dataclass(frozen=True)
class PosedPhotographs:
    """Photographs with a database of their features and matches."""

    #: Folder of the photographs.
    images: Path
    #: Folder of the database.
    work: Path
    #: Names and identifiers of images and cameras, which the database shares; poses are those that were given.
    scene: Scene
    options: PointModelOptions

    @property
    def database(self) -> Path:
        """The file of features and matches."""
        return self.work / "database.db"

    def match(self, say: Progress) -> None:
        """Find features and match them, as far as that is not done.

        Raises
        ------
        OutputError
            If there is no room in the folder, or pycolmap fails otherwise.
        """
        pycolmap, names = load_pycolmap(), list(self.scene.images.names)
        with quiet(pycolmap), explained(self.work):
            pycolmap.set_random_seed(self.options.seed)
            self.work.mkdir(parents=True, exist_ok=True)
            check_room(self.work)
            _enter(pycolmap, self.database, self.scene)
            find_features(pycolmap, self.database, self.images, names, self.options, say)
            match_pairs(pycolmap, self.database, names, _blocks(self.scene), self.options, say)

    def pairs(self) -> Iterator[MatchedPair]:
        """Yield the pairs whose matches agree on a motion between the two images."""
        pycolmap = load_pycolmap()
        with quiet(pycolmap), explained(self.work), opened(pycolmap, self.database) as content:
            row_of = {number: row for row, number in enumerate(self.scene.images.ids.tolist())}
            cameras = {camera.camera_id: camera for camera in content.read_all_cameras()}
            places = {number: content.read_keypoints(number)[:, :2].astype(float) for number in row_of}
            rays = {number: self._rays(row, places[number]) for number, row in row_of.items()}
            numbers, geometries = content.read_two_view_geometries()
            for number, geometry in zip(numbers, geometries, strict=True):
                first, second = pycolmap.pair_id_to_image_pair(number)
                matches = geometry.inlier_matches
                if len(matches) < MIN_MATCHES or first not in row_of or second not in row_of:
                    continue
                of = [cameras[self._camera_id(row_of[k])] for k in (first, second)]
                if not pycolmap.estimate_two_view_geometry_pose(of[0], places[first], of[1], places[second], geometry):
                    continue
                motion = geometry.cam2_from_cam1
                shift = np.asarray(motion.translation, float)
                if not np.linalg.norm(shift) > 0.0:
                    continue
                yield MatchedPair(
                    row_of[first],
                    row_of[second],
                    rays[first][matches[:, 0]],
                    rays[second][matches[:, 1]],
                    np.concatenate([motion.rotation.quat, shift / np.linalg.norm(shift)]),
                    float(np.sqrt(of[0].mean_focal_length() * of[1].mean_focal_length())),
                )

    def _camera_id(self, row: int) -> int:
        return int(self.scene.cameras.ids[self.scene.images.camera_idx[row]])

    def _rays(self, row: int, pixels: FloatArray) -> FloatArray:
        camera = int(self.scene.images.camera_idx[row])
        model = camera_models.model(self.scene.cameras.models[camera])
        rays = model.unproject(self.scene.cameras.params_of(camera), pixels)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def triangulate(self, scene: Scene, max_error_px: float) -> Scene:
        """Return images of the same identifiers with the points that their matches give at their poses."""
        pycolmap = load_pycolmap()
        options = pycolmap.IncrementalPipelineOptions()
        options.max_extra_param = options.triangulation.max_extra_param = np.inf  # a given lens is not doubted
        options.num_threads = 1  # as in reconstruct_points: points must not depend on which thread is first
        for part in (options, options.mapper, options.triangulation):
            part.random_seed = self.options.seed
        angle = float(np.degrees(max_error_px / _pixels_per_radian(scene)))
        options.mapper.filter_max_reproj_error = max_error_px
        for name in ("create_max_angle_error", "continue_max_angle_error"):
            setattr(options.triangulation, name, max(angle, getattr(options.triangulation, name)))
        for name in ("merge_max_reproj_error", "complete_max_reproj_error"):
            setattr(options.triangulation, name, max_error_px)
        bare = scene.points_only().replace(pose_priors=PosePriors())
        with quiet(pycolmap), explained(self.work):
            start = to_pycolmap(bare.keep(points=[]))
            found = pycolmap.triangulate_points(
                start, self.database, self.images, self.work / "points", options=options
            )
            return from_pycolmap(found)

    def place(self, row: int, model: Scene, max_error_px: float) -> tuple[FloatArray, int] | None:
        """Return the pose (7,) of an image that a model lacks by the points it shares, and how many agree.

        ``model`` has the identifiers of :attr:`scene`. None where too few points are shared or agree.
        """
        pycolmap = load_pycolmap()
        number = int(self.scene.images.ids[row])
        seen = model.point_observations
        image_ids = model.images.ids[seen.image_idx]
        pixels, points = [], []
        with quiet(pycolmap), explained(self.work), opened(pycolmap, self.database) as content:
            places = content.read_keypoints(number)[:, :2].astype(float)
            for other in model.images.ids.tolist():
                if other == number or not content.exists_two_view_geometry(number, other):
                    continue
                matches = content.read_two_view_geometry(number, other).inlier_matches.astype(np.int64)
                at = image_ids == other
                point_of = np.full(int(matches[:, 1].max(initial=-1)) + 1, -1)
                known = seen.keypoint_idx[at] < len(point_of)
                point_of[seen.keypoint_idx[at][known]] = seen.point_idx[at][known]
                found = point_of[matches[:, 1]]
                pixels.append(matches[found >= 0, 0])
                points.append(found[found >= 0])
            if not pixels:
                return None
            together = np.unique(np.stack([np.concatenate(pixels), np.concatenate(points)]), axis=1)
            if together.shape[1] < MIN_MATCHES:
                return None
            estimation = pycolmap.AbsolutePoseEstimationOptions()
            estimation.ransac.max_error = max_error_px
            estimation.ransac.random_seed = self.options.seed
            camera = content.read_camera(self._camera_id(row))
            answer = pycolmap.estimate_and_refine_absolute_pose(
                places[together[0]], model.points.xyz[together[1]], camera, estimation
            )
        if answer is None or answer["num_inliers"] < MIN_MATCHES:
            return None
        pose = answer["cam_from_world"]
        return np.concatenate([pose.rotation.quat, pose.translation]), int(answer["num_inliers"])


def _enter(pycolmap: Any, database: Path, scene: Scene) -> None:
    """Enter cameras, rigs, frames and images with the identifiers of a scene."""
    with opened(pycolmap, database) as content:
        if content.num_images() == scene.num_images:
            return
        content.clear_all_tables()  # a run was killed here
        model = to_pycolmap(scene.keep(points=[]))
        for camera in model.cameras.values():
            camera.has_prior_focal_length = True
            content.write_camera(camera, use_camera_id=True)
        for rig in model.rigs.values():
            content.write_rig(rig, use_rig_id=True)
        for image in model.images.values():
            alone = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
            content.write_image(alone, use_image_id=True)
        for frame in model.frames.values():
            content.write_frame(frame, use_frame_id=True)


def _pixels_per_radian(scene: Scene) -> float:
    focal = [
        np.mean(scene.cameras.params_of(row)[list(camera_models.model(name).focal_indices)])
        for row, name in enumerate(scene.cameras.models)
    ]
    return float(np.median(focal))


def _blocks(scene: Scene) -> list[list[tuple[int, int]]]:
    """Return the pairs to match, in blocks."""
    axes = quaternion.rotate(quaternion.conjugate(scene.cam_from_world[:, :4]), np.array([0.0, 0.0, 1.0]))
    return blocks_of_pairs(scene.num_images, scene.cam_centers_in_world, axes)
