# SPDX-License-Identifier: BSD-3-Clause
"""Matches of segments for :func:`groma.mapping.lines.build.map_lines`, made pair by pair when they are asked for.

Each function returns a *provider*, a callable of two images of a scene that gives their LineMatches. What is needed of
one image (for example descriptors) is made once and kept; matches are not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt

from groma import cameras as camera_models
from groma.errors import InputError
from groma.features.contract import ImageView, SegmentMatcher
from groma.features.external import ExternalMatches
from groma.features.images import to_gray
from groma.features.matches import LineMatches
from groma.features.registry import MATCHERS
from groma.features.segments import Segments
from groma.scene import Scene

#: Gives the grey image of a number.
ImageReader = Callable[[int], npt.NDArray[np.generic]]
#: Gives the matches of two images; None where nothing is known about the pair.
MatchProvider = Callable[[int, int], LineMatches | None]


class _Matched:
    """Matches by a matcher; what it says of each image is kept."""

    def __init__(self, scene: Scene, segments: Sequence[Segments], image: ImageReader, matcher: SegmentMatcher) -> None:
        self.scene, self.segments, self.image, self.matcher = scene, segments, image, matcher
        self._described: dict[int, Any] = {}
        self._locks = [Lock() for _ in segments]  # threads ask at the same time
        seen = scene.point_observations
        self._by_image = np.argsort(seen.image_idx, kind="stable")
        self._first = np.searchsorted(seen.image_idx[self._by_image], np.arange(scene.num_images + 1))

    def __reduce__(self) -> tuple:
        return _Matched, (self.scene, self.segments, self.image, self.matcher)  # each process describes what it needs

    def _of(self, i: int) -> Any:
        with self._locks[i]:
            if i not in self._described:
                self._described[i] = self.matcher.describe(self._view(i))
            return self._described[i]

    def _view(self, i: int) -> ImageView:
        scene, seen = self.scene, self.scene.point_observations
        camera, rows = scene.images.camera_idx[i], self._by_image[self._first[i] : self._first[i + 1]]
        return ImageView(
            name=scene.images.names[i],
            image=to_gray(self.image(i)),
            segments=self.segments[i],
            camera_model=camera_models.model(scene.cameras.models[camera]),
            camera_params=scene.cameras.params_of(camera),
            cam_from_world=scene.cam_from_world[i],
            point_pixels=seen.pixel[rows],
            point_ids=seen.point_idx[rows],
        )

    def __call__(self, i: int, j: int) -> LineMatches:
        found = self.matcher.match(self._of(i), self._of(j))
        found.check(len(self.segments[i]), len(self.segments[j]))
        return found


def segment_matches(
    scene: Scene, segments: Sequence[Segments], image: ImageReader, matcher: str | SegmentMatcher = "wide_baseline"
) -> MatchProvider:
    """Match by a segment matcher.

    Parameters
    ----------
    scene : Scene
        Cameras, poses, and points with observations.
    segments : sequence of C Segments
        By image; pixels of the cameras as they are.
    image : callable
        Gives the image of a number.
    matcher : str or SegmentMatcher
        The matcher, or its name in :data:`groma.features.registry.MATCHERS`: ``wide_baseline`` matches by surroundings,
        shared points and the epipolar geometry of the scene's poses, ``flow`` by dense optical flow, for sequences.
    """
    if len(segments) != scene.num_images:
        raise InputError(f"segments must hold one set per image ({scene.num_images}); got {len(segments)}.")
    return _Matched(scene, segments, image, MATCHERS.make(matcher))


def given_matches(names: Sequence[str], matches: ExternalMatches) -> MatchProvider:
    """Matches of a file, by the names of images."""
    return partial(_match_of, names, matches)


def _match_of(names: Sequence[str], matches: ExternalMatches, i: int, j: int) -> LineMatches:
    return matches.match(names[i], names[j])
