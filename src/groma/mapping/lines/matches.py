# SPDX-License-Identifier: BSD-3-Clause
"""Matches of segments for :func:`groma.mapping.lines.build.map_lines`, made pair by pair when they are asked for.

Each function returns a *provider*, a callable of two images of a scene that gives their LineMatches. What is needed of
one image (descriptors, undistorted segments, nearby points) is made once and kept; matches are not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from groma import cameras as camera_models
from groma.errors import InputError
from groma.features.external import ExternalMatches
from groma.features.matches import LineMatches
from groma.features.matching.descriptor import Descriptors, describe
from groma.features.matching.flow import FlowOptions, match_by_flow
from groma.features.matching.nearby import NearbyPoints, nearby_points
from groma.features.matching.wide_baseline import WideBaselineOptions, fundamental_from_poses, match_wide_baseline
from groma.features.segments import Segments
from groma.geometry import quaternion
from groma.scene import Scene

#: Gives the grey image of a number.
ImageReader = Callable[[int], npt.NDArray[np.generic]]
#: Gives the matches of two images; None where nothing is known about the pair.
MatchProvider = Callable[[int, int], LineMatches | None]


class _WideBaseline:
    def __init__(
        self, scene: Scene, segments: Sequence[Segments], image: ImageReader, options: WideBaselineOptions
    ) -> None:
        self.scene, self.segments, self.image, self.options = scene, segments, image, options
        self._kept: dict[int, tuple[Segments, Descriptors, NearbyPoints, np.ndarray]] = {}
        poses = scene.cam_from_world
        self._pose = np.concatenate([quaternion.to_matrix(poses[:, :4]), poses[:, 4:, None]], axis=2)
        seen = scene.point_observations
        self._by_image = np.argsort(seen.image_idx, kind="stable")
        self._first = np.searchsorted(seen.image_idx[self._by_image], np.arange(scene.num_images + 1))

    def _prepare(self, i: int) -> tuple[Segments, Descriptors, NearbyPoints, np.ndarray]:
        if i not in self._kept:
            scene, segments = self.scene, self.segments[i]
            camera = scene.images.camera_idx[i]
            model, params = camera_models.model(scene.cameras.models[camera]), scene.cameras.params_of(camera)
            # Segments without an undistorted image stay where they are; mapping does not use them.
            straight = model.undistort_pixels(params, segments.ends.reshape(-1, 2)).reshape(-1, 4)
            straight = np.where(np.isfinite(straight).all(1, keepdims=True), straight, segments.ends)
            rows = self._by_image[self._first[i] : self._first[i + 1]]
            seen = scene.point_observations
            near = nearby_points(segments, seen.pixel[rows], seen.point_idx[rows], self.options.reach)
            ideal = Segments(straight, segments.sigma, segments.strength)
            self._kept[i] = ideal, describe(self.image(i), segments), near, model.camera_matrix(params)
        return self._kept[i]

    def __call__(self, i: int, j: int) -> LineMatches:
        one, described_1, near_1, K1 = self._prepare(i)
        two, described_2, near_2, K2 = self._prepare(j)
        F = fundamental_from_poses(self._pose[i], self._pose[j], K1, K2)
        known = F if np.abs(F).max() > 0.0 else None
        return match_wide_baseline(one, two, described_1, described_2, (near_1, near_2), known, self.options)


def wide_baseline_matches(
    scene: Scene, segments: Sequence[Segments], image: ImageReader, options: WideBaselineOptions | None = None
) -> MatchProvider:
    """Match by surroundings, shared points and the epipolar geometry of the scene's poses.

    Parameters
    ----------
    scene : Scene
        Cameras, poses, and points with observations.
    segments : sequence of C Segments
        By image; pixels of the cameras as they are.
    image : callable
        Gives the image of a number.
    options : WideBaselineOptions, optional
        Gates and thresholds of :func:`groma.features.matching.wide_baseline.match_wide_baseline`.
    """
    _one_per_image(scene, segments)
    return _WideBaseline(scene, segments, image, options or WideBaselineOptions())


def flow_matches(
    scene: Scene, segments: Sequence[Segments], image: ImageReader, options: FlowOptions | None = None
) -> MatchProvider:
    """Match by dense optical flow, for images of a sequence; pairs of images of different size have no matches.

    Parameters are those of :func:`wide_baseline_matches`, options those of
    :func:`groma.features.matching.flow.match_by_flow`.
    """
    _one_per_image(scene, segments)

    def provide(i: int, j: int) -> LineMatches:
        one, two = image(i), image(j)
        if one.shape != two.shape:
            return LineMatches.empty()
        return match_by_flow(one, two, segments[i], segments[j], options)

    return provide


def external_matches(scene: Scene, segments: Sequence[Segments], matches: ExternalMatches) -> MatchProvider:
    """Matches of a file, by the names of the images.

    Raises
    ------
    InputError
        If matches refer to segments that do not exist: they were made from other segments than those mapped.
    """
    _one_per_image(scene, segments)
    index = {name: i for i, name in enumerate(scene.images.names)}
    for (first, second), found in matches.matches.items():
        if first in index and second in index:
            try:
                found.check(len(segments[index[first]]), len(segments[index[second]]))
            except InputError as error:
                raise InputError(f"Matches of {first} and {second}: {error}") from error
    names = scene.images.names
    return lambda i, j: matches.match(names[i], names[j])


def _one_per_image(scene: Scene, segments: Sequence[Segments]) -> None:
    if len(segments) != scene.num_images:
        raise InputError(f"segments must hold one set per image ({scene.num_images}); got {len(segments)}.")


__all__ = ["ImageReader", "MatchProvider", "external_matches", "flow_matches", "wide_baseline_matches"]
