# SPDX-License-Identifier: BSD-3-Clause
"""What is found in a photograph: described points (SIFT) and described segments.

Descriptors are the roots of SIFT's, whose products compare histograms better (R. Arandjelović, A. Zisserman, *Three
things everyone should know to improve object retrieval*, 2012), in bytes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from groma._numba import unrolled_loop
from groma._rows import Rows, column
from groma._typing import BoolArray, FloatArray, IntArray
from groma.execution import together
from groma.features.contract import SegmentDetector
from groma.features.images import GrayImage
from groma.features.matching.descriptor import Descriptors, describe
from groma.features.point_tracks import POINT_TRACKS
from groma.features.registry import DETECTORS
from groma.features.segments import Segments
from groma.features.sift import Blobs, describe_upright, find_blobs
from groma.gates import gate
from groma.localization.pose.camera import QueryCamera
from groma.mapping.image_segments import Straightener, is_used, segments_used

Bytes = npt.NDArray[np.uint8]
#: A descriptor of length one, in bytes, has about this length (the format of COLMAP's descriptors).
_LENGTH = 512.0
#: Shortest segment unless the caller says so, pixels.
MIN_LENGTH = 15.0


@dataclass(frozen=True)
class FeatureGates:
    """Which points and segments of a photograph are looked at."""

    max_points: int = gate(4000, "points", "described in an image, the strongest", "cost: of matching")
    contrast: float = gate(0.02, "1", "least contrast of a point, OpenCV's units", "convention: half of its default")
    sigma: float = gate(
        0.2, "share", "noise of a point over the standard deviation of the blur it was found at",
        "derived from residuals of triangulated points",
    )  # fmt: skip
    max_corners: int = gate(1000, "points", "corners described besides, the strongest", "cost: of matching")
    corner_distance: float = gate(6.0, "px", "least distance of corners", "cost: of matching")
    min_sigma: float = gate(0.4, "px", "least noise of a point", "derived from residuals of triangulated points")


FEATURES = FeatureGates()


# ---------------------------------------------------------------------------------------------------------- Kernels
@unrolled_loop
def _sum(descriptor, owner, total):
    for n in range(len(owner)):
        square = np.float32(0.0)
        for j in range(descriptor.shape[1]):
            square += np.float32(descriptor[n, j]) ** 2
        factor = np.float32(1.0) / np.sqrt(max(square, np.float32(1e-6)))
        for j in range(descriptor.shape[1]):
            total[owner[n], j] += factor * descriptor[n, j]


@unrolled_loop
def _unit(descriptor, out):
    for n in range(descriptor.shape[0]):
        square = 0.0
        for j in range(descriptor.shape[1]):
            square += np.float64(descriptor[n, j]) ** 2
        factor = 1.0 / max(np.float64(np.float32(np.sqrt(square))), 1e-6)
        for j in range(descriptor.shape[1]):
            out[n, j] = np.float32(factor * np.float64(descriptor[n, j]))


# ----------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True, eq=False)
class DescribedPoints(Rows):
    """Points of an image."""

    #: (n, 2) pixels, (n,) their standard deviations.
    pixels: FloatArray = column(2)
    sigma: FloatArray = column()
    #: (n, 128) descriptors, and which of them are upright instead of along the direction of the gradients.
    descriptors: Bytes = column(128, dtype=np.uint8)
    upright: BoolArray = column(dtype=bool)


@dataclass(frozen=True, eq=False)
class DescribedImage:
    """Points and segments of an image."""

    points: DescribedPoints
    segments: Segments
    #: (m, 72) of the segments.
    segment_descriptors: Descriptors
    #: (H, W) what may be used of the image; None: all.
    used: BoolArray | None = None

    def with_points(self, points: DescribedPoints) -> DescribedImage:
        """The same segments, and other points."""
        return replace(self, points=points)


def find_points(image: GrayImage) -> DescribedPoints:
    """Find and describe blobs of any scale and direction."""
    return _described(find_blobs(image, FEATURES.max_points, FEATURES.contrast), False)


def find_corners(image: GrayImage) -> DescribedPoints:
    """Find and describe corners, at one scale and upright: maps of sequences consist of such."""
    found = cv2.goodFeaturesToTrack(image, FEATURES.max_corners, POINT_TRACKS.quality, FEATURES.corner_distance)
    if found is None:
        return DescribedPoints.empty()
    return describe_places(image, found.reshape(-1, 2).astype(np.float64) + 0.5)[0]


def describe_places(image: GrayImage, pixels: FloatArray) -> tuple[DescribedPoints, IntArray]:
    """Describe given places (n, 2), upright; those at the border are left out: also return the rows that are left."""
    found, rows = describe_upright(image, pixels)
    return _described(found, True), rows


def _described(found: Blobs, upright: bool) -> DescribedPoints:
    root = np.sqrt(found.descriptors / np.maximum(found.descriptors.sum(axis=1, keepdims=True), 1e-9))
    octets = np.minimum(np.round(_LENGTH * root), 255.0).astype(np.uint8)
    sigma = np.maximum(FEATURES.sigma * (0.5 * found.size), FEATURES.min_sigma)
    return DescribedPoints(found.pixels, sigma, octets, np.full(len(found), upright))


def mirrored(points: DescribedPoints, width: int) -> DescribedPoints:
    """Return what would be found in the mirror image (left and right exchanged) of an image that is so wide.

    A descriptor has 4 rows across and 4 columns along its direction, of 8 orientations. Blobs have a direction of their
    own, which is mirrored, too: rows change places. Corners are described upright: columns do.
    """
    cells = points.descriptors.reshape(-1, 4, 4, 8)
    turn = np.arange(8)
    blobs = cells[:, ::-1][..., (8 - turn) % 8].reshape(-1, 128)
    corners = cells[:, :, ::-1][..., (12 - turn) % 8].reshape(-1, 128)
    descriptors = np.where(points.upright[:, None], corners, blobs)
    pixels = np.column_stack([width - points.pixels[:, 0], points.pixels[:, 1]])
    return DescribedPoints(pixels, points.sigma, descriptors, points.upright)


def unit(descriptors: Bytes) -> npt.NDArray[np.float32]:
    """Descriptors (n, 128) as vectors of length one."""
    vectors = np.empty(descriptors.shape, np.float32)
    _unit(descriptors, vectors)
    return vectors


def summed(descriptors: Bytes, owner: IntArray, count: int) -> npt.NDArray[np.float32]:
    """Sums (count, 128) of the descriptors of each owner, each of length one."""
    total = np.zeros((count, 128), np.float32)
    _sum(descriptors, owner, total)
    return total


def find_features(
    image: GrayImage,
    camera: QueryCamera,
    lines: bool = True,
    min_length: float = MIN_LENGTH,
    used: BoolArray | None = None,
) -> DescribedImage:
    """Find and describe points and segments in what is used (H, W); segments without the distortion of the lens."""

    def segments() -> tuple[Segments, Descriptors]:
        detector = DETECTORS.make("lsd", min_length=min_length, max_segments=0)
        found = _segments(image, camera, detector) if lines else Segments.empty()
        found = found if used is None else segments_used(found, used)
        return found, describe(image, found)

    points, found = together(lambda: find_points(image).joined(find_corners(image)), segments)
    if used is not None:
        points = points.take(is_used(used, points.pixels))
    return DescribedImage(points, *found, used=used)


def _segments(image: GrayImage, camera: QueryCamera, detector: SegmentDetector) -> Segments:
    straightener = _straightener(camera.model, tuple(camera.params.tolist()), image.shape[1], image.shape[0])
    return detector.detect(image) if straightener is None else straightener.detect(detector, image)


@lru_cache(maxsize=2)
def _straightener(model: str, params: tuple[float, ...], width: int, height: int) -> Straightener | None:
    from groma import cameras

    return Straightener.of(cameras.model(model), np.array(params), width, height)
