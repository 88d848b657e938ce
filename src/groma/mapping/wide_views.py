# SPDX-License-Identifier: BSD-3-Clause
"""Images wider than a plane can hold, as several flat views: panoramas, fisheyes.

A straight edge is a curve in such an image. The directions that it sees are divided among the six sides of a cube
around the camera, and each side is a pinhole view with the resolution of the image. Views reach beyond their sides, so
that edges are measured as well at a border as elsewhere; what is found belongs to the side on which it lies, and an
edge that runs across a border to both, in parts that do not overlap. Within a view all is as in any photograph.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from groma import cameras as camera_models
from groma._typing import BoolArray, FloatArray, IntArray
from groma.cameras.across import pixels_across
from groma.features.contract import SegmentDetector
from groma.features.images import GrayImage
from groma.features.segments import Segments
from groma.gates import gate
from groma.geometry import segment2
from groma.geometry.algebra import unit


@dataclass(frozen=True)
class WideGates:
    """Which images are seen in several views, and how far views reach."""

    max_lost: float = gate(0.05, "share", "of an image that a plane twice its size lacks", "convention: one in twenty")
    overlap: float = gate(5.0, "deg", "of a view beyond its side of the cube", "cost: edges at a border are whole")
    max_fold: float = gate(0.5, "px", "of a pixel whose ray is projected again", "convention: half a pixel")
    border: float = gate(2.0, "px", "at the end of what a camera sees, where nothing is found", "derived from the blur")
    min_share: float = gate(0.01, "share", "of an image that a view shows", "cost: a view for less finds nothing")


GATES = WideGates()
#: Samples along a segment, to find the part of it that belongs to a view (cost: time).
_SAMPLES = 65
#: Samples along each side of an image (cost: time).
_GRID = 128
#: Directions of the views, camera frame, and which way is right in them.
_AXES = np.array([[0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], float)
_RIGHT = np.array([[1, 0, 0], [0, 0, -1], [-1, 0, 0], [0, 0, 1], [1, 0, 0], [1, 0, 0]], float)
_PINHOLE = camera_models.model("PINHOLE")


@dataclass(frozen=True, eq=False)
class WideViews:
    """The views of a camera, and what belongs to which."""

    model: camera_models.CameraModel
    params: FloatArray
    #: (width, height) of the image.
    size: tuple[int, int]
    #: (V, 3, 3) views from the camera, their axes in the rows.
    view_from_cam: FloatArray
    #: (V, 4) fx, fy, cx, cy of the views.
    pinhole: FloatArray
    #: (V, 2) width and height of the views.
    view_size: IntArray

    @staticmethod
    def of(model: camera_models.CameraModel, params: FloatArray, width: int, height: int) -> WideViews | None:
        """Return the views of a camera; None where one plane holds enough of its image."""
        if not model.sees_behind or not (width and height):
            return None
        u, v = np.meshgrid((np.arange(_GRID) + 0.5) / _GRID * width, (np.arange(_GRID) + 0.5) / _GRID * height)
        pixels = np.column_stack([u.ravel(), v.ravel()])
        rays, seen = _rays(model, params, pixels)
        pixels, rays = pixels[seen], rays[seen]
        if len(rays) == 0 or not _is_wide(model, params, pixels, (width, height)):
            return None
        _, by_ray, _ = model.project_jacobian(params, rays)
        focal = float(np.median(np.linalg.svd(by_ray, compute_uv=False)[:, 1]))
        side = (rays @ _AXES.T).argmax(axis=1)
        reach = np.tan(np.radians(45.0 + GATES.overlap))  # derived from a cube
        turns, pinhole, sizes = [], [], []
        for k in np.flatnonzero(np.bincount(side, minlength=len(_AXES)) >= GATES.min_share * len(rays)):
            turn = np.stack([_RIGHT[k], np.cross(_AXES[k], _RIGHT[k]), _AXES[k]])
            # Coarse steps between samples, and the part of the plane that they cover.
            places = rays[side == k] @ turn.T
            shown = places[:, :2] / places[:, 2:]
            slack = (reach - 1.0) + 4.0 / _GRID
            low, high = np.maximum(shown.min(0) - slack, -reach), np.minimum(shown.max(0) + slack, reach)
            turns.append(turn)
            pinhole.append([focal, focal, *(-focal * low)])
            sizes.append(np.ceil(focal * (high - low)))
        return WideViews(model, params, (width, height), np.array(turns), np.array(pinhole), np.array(sizes, np.int64))

    def __len__(self) -> int:
        return len(self.view_from_cam)

    def view_of(self, rays: FloatArray) -> IntArray:
        """Return the view (N,) to which rays (N, 3) in the camera frame belong."""
        return np.asarray((rays @ self.view_from_cam[:, 2].T).argmax(axis=1), np.int64)

    def is_own(self, view: int, rays: FloatArray) -> BoolArray:
        """Whether the camera sees rays (N, 3), and they belong to a view."""
        along = rays @ _AXES.T
        own = along.max(axis=1) <= rays @ self.view_from_cam[view, 2] + 1e-12
        pixels = self.model.project(self.params, rays)
        inside = np.all((pixels >= GATES.border) & (pixels <= np.array(self.size) - GATES.border), axis=1)
        if not self.model.is_planar:  # its borders are places like any other
            inside = np.isfinite(pixels).all(axis=1)
        own &= inside
        # Far out, polynomial lens models fold the sphere back into the image; only pixels that map back to it count.
        again = self.model.unproject(self.params, pixels[own])
        focal = self.pinhole[view, 0]
        own[own] = np.linalg.norm(again - unit(rays[own]), axis=1) * focal < GATES.max_fold
        return own

    def to_view(self, view: int, rays: FloatArray) -> FloatArray:
        """Pixels (N, 2) of a view, from rays (N, 3) in the camera frame, before it."""
        turned = rays @ self.view_from_cam[view].T
        return turned[:, :2] / turned[:, 2:] * self.pinhole[view, :2] + self.pinhole[view, 2:]

    def from_view(self, view: int, pixels: FloatArray) -> FloatArray:
        """Unit rays (N, 3) in the camera frame, from pixels (N, 2) of a view."""
        plane = (pixels - self.pinhole[view, 2:]) / self.pinhole[view, :2]
        return unit(np.column_stack([plane, np.ones(len(plane))]) @ self.view_from_cam[view])

    def noise_ratio(self, view: int, first: FloatArray, second: FloatArray) -> FloatArray:
        """Pixels of the image across a segment, of the rays (N, 3) of its ends, per pixel of a view."""
        turn = self.view_from_cam[view]
        flat = pixels_across(_PINHOLE, self.pinhole[view], first @ turn.T, second @ turn.T)
        curved = pixels_across(self.model, self.params, first, second)
        return np.sqrt((curved**2).sum(axis=1) / (flat**2).sum(axis=1))

    def source(self, view: int) -> npt.NDArray[np.float32]:
        """(H, W, 2): where each pixel of a view lies in the image, in array coordinates."""
        columns, rows = self.view_size[view]
        places = np.empty((rows, columns, 2), np.float32)
        for row in range(rows):
            pixels = np.column_stack([np.arange(columns) + 0.5, np.full(columns, row + 0.5)])
            found = self.model.project(self.params, self.from_view(view, pixels))
            places[row] = np.where(np.isfinite(found), found - 0.5, -1e6)
        return places

    def to_image(self, view: int, segments: Segments) -> Segments:
        """Segments of the image, from those of a view that belong to it."""
        first, second = (self.from_view(view, segments.ends[:, part]) for part in (slice(0, 2), slice(2, 4)))
        start = self.model.project(self.params, first)
        # In a panorama, on across the border rather than back through the image.
        end = start + self.model.pixel_difference(self.params, self.model.project(self.params, second), start)
        sigma = segments.sigma * self.noise_ratio(view, first, second)
        return replace(segments, ends=np.hstack([start, end]), sigma=sigma)


@dataclass(frozen=True, eq=False)
class WideDetection:
    """Finds segments in the images of one camera, view by view."""

    views: WideViews
    #: For each view, where its pixels lie in the image.
    sources: tuple[npt.NDArray[np.float32], ...]

    @staticmethod
    def of(views: WideViews) -> WideDetection:
        """Return the one of the views of a camera."""
        return WideDetection(views, tuple(views.source(view) for view in range(len(views))))

    def detect(self, detector: SegmentDetector, image: GrayImage) -> Segments:
        """Find segments in an image of this camera; their end points are pixels of the image as it is."""
        border = cv2.BORDER_REPLICATE if self.views.model.is_planar else cv2.BORDER_WRAP
        parts = []
        for view, source in enumerate(self.sources):
            flat = cv2.remap(image, source, None, cv2.INTER_CUBIC, borderMode=border)  # type: ignore[call-overload]
            parts.append(self.views.to_image(view, self._own(view, detector.detect(flat))))
        return Segments.joined(parts)

    def _own(self, view: int, found: Segments) -> Segments:
        """The parts of segments that belong to a view, as far as they are long enough to be found."""
        return parts_inside(found, lambda pixels: self.views.is_own(view, self.views.from_view(view, pixels)))


def parts_inside(found: Segments, is_inside: Callable[[FloatArray], BoolArray]) -> Segments:
    """Return what of each segment lies inside, from the first to the last such pixel; none shorter than any found."""
    if len(found) == 0:
        return found
    along = np.linspace(0.0, 1.0, _SAMPLES)[:, None]
    places = found.ends[:, None, :2] * (1.0 - along) + found.ends[:, None, 2:] * along
    inside = is_inside(places.reshape(-1, 2)).reshape(len(found), _SAMPLES)
    first, last = inside.argmax(axis=1), _SAMPLES - 1 - inside[:, ::-1].argmax(axis=1)
    rows = np.arange(len(found))
    ends = np.hstack([places[rows, first], places[rows, last]])
    keep = inside.any(axis=1) & (segment2.length(ends) >= segment2.length(found.ends).min())
    return replace(found.select(keep), ends=ends[keep])


def _rays(model: camera_models.CameraModel, params: FloatArray, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Rays of pixels, and whether they project back to the pixel."""
    rays = model.unproject(params, pixels)
    seen: BoolArray = np.asarray(np.isfinite(rays).all(axis=1), np.bool_)
    back = model.project(params, np.where(seen[:, None], rays, [0.0, 0.0, 1.0]))
    seen &= np.linalg.norm(model.pixel_difference(params, back, pixels), axis=1) < GATES.max_fold
    return rays, seen


def _is_wide(model: camera_models.CameraModel, params: FloatArray, pixels: FloatArray, size: tuple[int, int]) -> bool:
    """Whether one plane, twice as large as the image, loses more of it than may be."""
    if not model.is_planar:
        return True
    straight, whole = model.undistort_pixels(params, pixels), np.array(size, float)
    kept = np.all((straight >= -0.5 * whole) & (straight <= 1.5 * whole), axis=1)
    return bool(kept.mean() < 1.0 - GATES.max_lost)
