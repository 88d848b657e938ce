# SPDX-License-Identifier: BSD-3-Clause
"""What can be exchanged in the images: segment detectors, segment matchers and image retrieval.

Each is a protocol: any object with these methods will do. :mod:`groma.features.registry` knows them by name, those of
installed packages too. Make them frozen dataclasses of their settings: finished stages of ``groma map`` are found again
by class and settings; of other objects by ``repr``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.cameras import CameraModel
from groma.features.images import GrayImage
from groma.features.matches import LineMatches
from groma.features.segments import Segments


@runtime_checkable
class SegmentDetector(Protocol):
    """Finds line segments in an image; called from several threads."""

    def detect(self, image: npt.NDArray[np.generic]) -> Segments:
        """Segments of an image (H, W) or (H, W, 3), 8 bit.

        Pixels count from the corner of the image (first pixel's centre at 0.5, 0.5), the darker side lies to the left
        of each segment, and ``sigma`` is the standard deviation of the end points across the segment. An image
        without edges gives no segments; nothing is raised.
        """
        ...


@dataclass(frozen=True, eq=False)
class ImageView:
    """The input of a segment matcher for one image."""

    #: Name of the image.
    name: str
    #: (H, W) uint8 grey levels.
    image: GrayImage
    #: What was found in it; pixels of the image as it is.
    segments: Segments
    #: The camera, and its parameters (k,).
    camera_model: CameraModel
    camera_params: FloatArray
    #: (7,) pose [qx qy qz qw tx ty tz]; None where it is not known.
    cam_from_world: FloatArray | None
    #: (N, 2) pixels of the points seen, and (N,) the number of each point, which is the same in all images.
    point_pixels: FloatArray
    point_ids: IntArray


@runtime_checkable
class SegmentMatcher(Protocol):
    """Finds which segments of two images show the same edge. Both methods are called from several threads."""

    def describe(self, view: ImageView) -> Any:
        """Return what :meth:`match` needs of one image; called once an image, and kept."""
        ...

    def match(self, first: Any, second: Any) -> LineMatches:
        """Return the matches of two described images; none where nothing is alike."""
        ...


@runtime_checkable
class ImageRetrieval(Protocol):
    """Tells which images of a set may show what another image shows; ``describe`` is called from several threads."""

    def describe(self, image: npt.NDArray[np.generic]) -> Any:
        """Return what :meth:`similarity` needs of one image (H, W) or (H, W, 3), 8 bit; called once an image."""
        ...

    def similarity(self, query: Any, others: Sequence[Any]) -> FloatArray:
        """Return how alike a described image is to each of others, (N,) finite numbers, higher is more alike."""
        ...
