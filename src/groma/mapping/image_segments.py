# SPDX-License-Identifier: BSD-3-Clause
"""The segments of all images, with one image in memory at a time, detected without lens distortion.

A lens with distortion images a straight edge as an arc, which a detector of straight segments breaks into short chords.
Images of such cameras are therefore resampled without distortion, with the same camera matrix. Segments are detected
there, and their end points are mapped back to the original image, in which the rest of groma measures. Images wider
than a plane can hold are resampled to several views (:mod:`groma.mapping.wide_views`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from groma import cameras as camera_models
from groma._counted import counted
from groma._typing import BoolArray, FloatArray
from groma.errors import InputError
from groma.execution import map_work
from groma.features.contract import SegmentDetector
from groma.features.contrast import contrast_of
from groma.features.external import ExternalMatches
from groma.features.images import GrayImage
from groma.features.segments import Segments
from groma.gates import gate
from groma.io.colmap.masks import Masks
from groma.mapping.photographs import read_gray
from groma.mapping.wide_views import GATES as WIDE
from groma.mapping.wide_views import WideDetection, WideViews, parts_inside
from groma.scene import Scene


@dataclass(frozen=True)
class LensGates:
    """When images are resampled without the distortion of their lens, and how large they may become."""

    negligible: float = gate(0.05, "px", "of pixels by a lens that is ignored", "derived from noise: a third")
    max_growth: float = gate(2.0, "1", "of the resampled image over the original", "cost: wide lenses lose corners")


GATES = LensGates()


@dataclass(frozen=True)
class Straightener:
    """Resamples the images of one camera without distortion, and maps segments back."""

    model: camera_models.CameraModel
    params: FloatArray
    #: (width, height) of the original image.
    size: tuple[int, int]
    #: (3, 3) camera matrix of the resampled image.
    K: FloatArray
    #: (H, W, 2) float32: where each of its pixels lies in the original, in array coordinates.
    source: npt.NDArray[np.float32]

    @staticmethod
    def of(model: camera_models.CameraModel, params: FloatArray, width: int, height: int) -> Straightener | None:
        """Return the one of a camera; None if its distortion is negligible."""
        u, v = np.linspace(0.0, width, 33), np.linspace(0.0, height, 33)
        border = np.concatenate([np.column_stack([u, np.full(33, side)]) for side in (0.0, height)])
        border = np.concatenate([border, *(np.column_stack([np.full(33, side), v]) for side in (0.0, width))])
        straight = model.undistort_pixels(params, border)
        straight = straight[np.isfinite(straight).all(1)]
        if len(straight) == len(border) and np.abs(straight - border).max() <= GATES.negligible:
            return None
        growth = 0.5 * (GATES.max_growth - 1.0) * np.array([width, height])
        corner = np.array([width, height], float)
        low = np.maximum(np.floor(straight.min(0, initial=0.0)), np.floor(-growth))
        high = np.minimum(np.ceil(straight.max(0, initial=0.0)), np.ceil(corner + growth))
        if len(straight) < len(border):  # a view so wide that its border has no place in a plane
            low, high = np.floor(-growth), np.ceil(corner + growth)
        K = model.camera_matrix(params).copy()
        K[:2, 2] -= low
        columns, rows = (high - low).astype(int)
        source = np.empty((rows, columns, 2), np.float32)
        u = np.arange(columns) + 0.5
        for row in range(rows):
            rays = np.column_stack([(u - K[0, 2]) / K[0, 0], np.full(columns, (row + 0.5 - K[1, 2]) / K[1, 1])])
            pixels = model.project(params, np.column_stack([rays, np.ones(columns)]))
            source[row] = np.where(np.isfinite(pixels), pixels - 0.5, -1e6)
        return Straightener(model, params, (width, height), K, source)

    def detect(self, detector: SegmentDetector, image: GrayImage) -> Segments:
        """Find segments in an image of this camera; their end points are pixels of the image as it is."""
        # The border is repeated: black outside would be an edge all around.
        straight = cv2.remap(image, self.source, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
        found = parts_inside(detector.detect(straight), self._inside)
        return replace(found, ends=self._bend(found.ends.reshape(-1, 2)).reshape(-1, 4))

    def _bend(self, pixels: FloatArray) -> FloatArray:
        """Pixels of the original image, from pixels of the resampled one."""
        rays = np.column_stack([(pixels - self.K[:2, 2]) / self.K[[0, 1], [0, 1]], np.ones(len(pixels))])
        return self.model.project(self.params, rays)

    def _inside(self, pixels: FloatArray) -> npt.NDArray[np.bool_]:
        bent = self._bend(pixels)
        inside = np.all((bent >= 0.0) & (bent <= np.array(self.size)), axis=1)
        # Far out, polynomial lens models fold the plane back into the image; only pixels that map back to it count.
        back = self.model.undistort_pixels(self.params, bent[inside]) + self._shift
        inside[inside] = np.all(np.abs(back - pixels[inside]) < WIDE.max_fold, axis=1)
        return inside

    @property
    def _shift(self) -> FloatArray:
        """From pixels without distortion to pixels of the resampled image."""
        return self.K[:2, 2] - self.model.camera_matrix(self.params)[:2, 2]


def detect_segments(
    folder: Path,
    scene: Scene,
    detector: SegmentDetector,
    say: Callable[[str, int, int], None],
    masks: Masks | None = None,
) -> list[Segments]:
    """Find the segments of every image of a scene, or of what masks leave of it; pixels of the images as they are."""
    cameras, names, camera_of = scene.cameras, scene.images.names, scene.images.camera_idx
    order = np.argsort(camera_of, kind="stable")  # what resamples a camera's images is made once for all of them
    of_camera = [(name, tuple(cameras.params_of(c).tolist())) for c, name in enumerate(cameras.models)]
    work = [(names[i], *of_camera[camera_of[i]]) for i in order]
    try:
        found = map_work(partial(_detect_in, folder, detector, masks), work, partial(say, "finding segments"))
    finally:
        _straightener.cache_clear()
    return [found[place] for place in np.argsort(order)]


def _detect_in(
    folder: Path, detector: SegmentDetector, masks: Masks | None, work: tuple[str, str, tuple[float, ...]]
) -> Segments:
    """The segments of an image, whose camera has a model and parameters."""
    name, model, params = work
    image = read_gray(folder / name)
    size = image.shape[1], image.shape[0]
    straightener = _straightener(model, params, *size)
    found = detector.detect(image) if straightener is None else straightener.detect(detector, image)
    used = None if masks is None else masks.read(name, size)
    return found if used is None else segments_used(found, used)


def check_masks(
    masks: Masks | None, sizes: Mapping[str, tuple[int, int]], say: Callable[[str, int, int], None]
) -> list[str]:
    """Say what the masks of photographs of these sizes (width, height) leave out.

    Raises
    ------
    InputError
        If one cannot be read, has other proportions than its photograph, or nothing is left.
    """
    if masks is None:
        return []
    found = [(name, size) for name, size in sizes.items() if name in masks.file_of]
    shares = map_work(partial(_share_used, masks), found, partial(say, "checking masks"))
    if not any(shares) and len(found) == len(sizes):
        raise InputError(f"The masks in {masks.folder} are all black, and only what is white is used. Turn them round.")
    rest = f"; {len(sizes) - len(found)} have none" if len(found) < len(sizes) else ""
    left_out = 100.0 * (1.0 - sum(shares) / max(len(shares), 1))
    return [f"Masks leave out {left_out:.2g} % of {counted(len(found), 'photographs')}{rest}."]


def _share_used(masks: Masks, photograph: tuple[str, tuple[int, int]]) -> float:
    used = masks.read(*photograph)
    return 1.0 if used is None else float(used.mean())


def segments_used(found: Segments, used: BoolArray) -> Segments:
    """Return what of each segment may be used of an image, (H, W): not the outline of what a mask hides."""
    reach = 2 * math.ceil(WIDE.border) + 1
    inside = cv2.erode(used.astype(np.uint8), np.ones((reach, reach), np.uint8)).astype(np.bool_)
    return parts_inside(found, partial(is_used, inside))


def is_used(used: BoolArray, pixels: FloatArray) -> BoolArray:
    """Return which pixels (N, 2) may be used of an image, (H, W)."""
    column, row = np.clip(pixels, 0, np.array(used.shape[::-1]) - 1).astype(np.int64).T
    return np.asarray(used[row, column])


# Few are kept: they are larger than the image, and there may be a camera for every image.
@lru_cache(maxsize=2)
def _straightener(
    model: str, params: tuple[float, ...], width: int, height: int
) -> Straightener | WideDetection | None:
    camera = camera_models.model(model), np.array(params), width, height
    wide = WideViews.of(*camera)
    return Straightener.of(*camera) if wide is None else WideDetection.of(wide)


def given_segments(
    folder: Path, scene: Scene, external: ExternalMatches, say: Callable[[str, int, int], None]
) -> list[Segments]:
    """Return segments from elsewhere, directed and rated by the grey levels of the images.

    Raises
    ------
    InputError
        If the file names other images, or has matches of segments that it does not hold.
    """
    names = set(scene.images.names)
    used = {name for pair in external.matches for name in pair} & names
    known = set(external.segments) & names
    if not known:
        example = min([*external.segments, *(name for pair in external.matches for name in pair)], default="none")
        raise InputError(
            f"The line matches hold segments of no image of the model; they name {example!r}, the model "
            f"{scene.images.names[0]!r}. Names must match."
        )
    if used - known:
        raise InputError(
            f"The line matches refer to segments of {min(used - known)!r}, but do not hold them. Add an array "
            f"'segments|{min(used - known)}'."
        )

    return map_work(partial(_given_in, folder, known, external), scene.images.names, partial(say, "reading segments"))


def _given_in(folder: Path, known: set[str], external: ExternalMatches, name: str) -> Segments:
    """The given segments of an image, none where they are not known."""
    if name not in known:
        return Segments.empty()
    image = read_gray(folder / name)
    found = external.segments_of(name, image)
    return replace(found, contrast=contrast_of(image, found))
