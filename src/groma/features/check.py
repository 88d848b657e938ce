# SPDX-License-Identifier: BSD-3-Clause
"""The conformance checks of detectors, matchers and retrieval, public in :mod:`groma.testing`.

They use one drawn picture, bright rectangles on a grey ground, whose edges are known; what is asked of a part is what
the pipelines rely on, not that it is good.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from groma import cameras
from groma._typing import FloatArray
from groma.errors import require
from groma.features.contract import ImageRetrieval, ImageView, SegmentDetector, SegmentMatcher
from groma.features.lsd import LsdDetector
from groma.features.segments import Segments

#: (x, y, width, height, grey) of the rectangles, pixels.
_RECTANGLES = ((60, 40, 130, 90, 230), (230, 60, 90, 150, 30), (80, 170, 110, 70, 160))
_SIZE = (360, 280)
#: The second picture of a pair is seen from so far to the right, pixels.
_SHIFT = 12


def picture(shift: int = 0) -> npt.NDArray[np.uint8]:
    """Return the drawn picture (280, 360), moved to the left by ``shift`` pixels."""
    image = np.full((_SIZE[1], _SIZE[0]), 110, np.float32)
    for x, y, width, height, grey in _RECTANGLES:
        image[y : y + height, max(x - shift, 0) : x + width - shift] = grey
    return np.round(cv2.GaussianBlur(image, (0, 0), 0.8)).astype(np.uint8)


def _edges() -> FloatArray:
    """(12, 4) edges of the picture, u1 v1 u2 v2."""
    edges = []
    for x, y, w, h, _ in _RECTANGLES:
        edges += [[x, y, x + w, y], [x, y + h, x + w, y + h], [x, y, x, y + h], [x + w, y, x + w, y + h]]
    return np.array(edges, np.float64)


def check_detector(detector: SegmentDetector) -> None:
    """Check that a detector keeps :class:`groma.features.contract.SegmentDetector`.

    It finds at least half of the edges of a drawn picture within a pixel; nearly all that it finds is an edge, with the
    darker side on its left; ``sigma`` is positive; the same picture gives the same; a picture of one grey gives
    nothing; the picture is left as it is.

    Raises
    ------
    AssertionError
        If one of these does not hold.
    """
    name, image = type(detector).__name__, picture()
    before = image.copy()
    found, again = detector.detect(image), detector.detect(image)
    require(isinstance(found, Segments), name, f"detect() must return Segments; got {type(found).__name__}")
    require(np.array_equal(image, before), name, "detect() changed the image")
    require(np.array_equal(found.ends, again.ends), name, "the same image gives other segments the second time")
    finite = bool(np.isfinite(found.ends).all() and np.isfinite(found.sigma).all())
    require(finite and bool((found.sigma > 0.0).all()), name, "end points and sigma must be finite, sigma positive")
    near = _distances(found.ends, _edges()) < 1.0
    hit, on_edge = np.any(near, axis=0), np.any(near, axis=1)
    require(hit.mean() >= 0.5, name, f"only {hit.sum()} of {len(hit)} edges are found; first pixel's centre at 0.5?")
    require(on_edge.mean() >= 0.9, name, f"{(~on_edge).sum()} of {len(found)} segments lie on no edge")
    darker = _left_is_darker(image, found.ends[on_edge])
    require(darker.mean() >= 0.9, name, "the darker side must lie to the left of the way from first to second end")
    for blank in (np.full((60, 80), 90, np.uint8), np.zeros((4, 4), np.uint8)):
        require(len(detector.detect(blank)) == 0, name, f"an image of one grey {blank.shape} gives segments")


def _distances(ends: FloatArray, edges: FloatArray) -> FloatArray:
    """(N, E) largest distance of a segment's two ends from an edge's line; infinite beside the edge's extent."""
    direction = edges[:, 2:] - edges[:, :2]
    length = np.linalg.norm(direction, axis=1)
    direction = direction / length[:, None]
    offset = ends.reshape(-1, 2, 1, 2) - edges[:, :2]
    along = (offset * direction).sum(-1)
    across = np.abs(offset[..., 0] * direction[:, 1] - offset[..., 1] * direction[:, 0])
    inside = ((along > -3.0) & (along < length + 3.0)).all(axis=1)
    return np.where(inside, across.max(axis=1), np.inf)


def _left_is_darker(image: npt.NDArray[np.uint8], ends: FloatArray) -> npt.NDArray[np.bool_]:
    middle, along = 0.5 * (ends[:, :2] + ends[:, 2:]), ends[:, 2:] - ends[:, :2]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    left = np.column_stack([along[:, 1], -along[:, 0]])  # v points down
    grey = []
    for side in (left, -left):
        column, row = np.clip(middle + 4.0 * side, 0.0, np.array(_SIZE) - 1.0).astype(int).T
        grey.append(image[row, column].astype(int))
    return grey[0] < grey[1]


def _view(number: int) -> ImageView:
    image, model = picture(_SHIFT * number), cameras.PINHOLE
    params = np.array([400.0, 400.0, 180.0, 140.0])
    # A plane at depth 4: a step of 0.12 to the right moves it by 12 pixels to the left.
    pose = np.array([0.0, 0.0, 0.0, 1.0, -0.12 * number, 0.0, 0.0])
    corners = np.array([[x, y] for x, y, *_ in _RECTANGLES], np.float64) - [_SHIFT * number, 0.0]
    segments = LsdDetector().detect(image)
    return ImageView(f"{number}.png", image, segments, model, params, pose, corners, np.arange(len(corners)))


def check_matcher(matcher: SegmentMatcher) -> None:
    """Check that a matcher keeps :class:`groma.features.contract.SegmentMatcher`.

    Of two views of a drawn wall at least half of the segments are matched, nine of ten rightly; indices exist; an image
    without segments, and an unknown pose, do no harm.

    Raises
    ------
    AssertionError
        If one of these does not hold.
    """
    name, views = type(matcher).__name__, [_view(0), _view(1)]
    first, second = (matcher.describe(view) for view in views)
    found = matcher.match(first, second)
    found.check(len(views[0].segments), len(views[1].segments))
    one, two = views[0].segments.ends[found.pairs[:, 0]], views[1].segments.ends[found.pairs[:, 1]]
    right = np.abs(one - two - [_SHIFT, 0.0, _SHIFT, 0.0]).max(axis=1, initial=0.0) < 3.0
    min_matches = 0.5 * min(len(view.segments) for view in views)
    require(
        len(found) >= min_matches, name, f"only {len(found)} segments are matched; expected at least {min_matches:.0f}"
    )
    require(right.mean() >= 0.9, name, f"{(~right).sum()} of {len(found)} matches are wrong")
    bare = _with(views[1], segments=Segments.empty())
    require(len(matcher.match(first, matcher.describe(bare))) == 0, name, "an image without segments has matches")
    matcher.match(first, matcher.describe(_with(views[1], cam_from_world=None)))


def _with(view: ImageView, **changes: object) -> ImageView:
    return ImageView(**{**vars(view), **changes})


def check_retrieval(retrieval: ImageRetrieval) -> None:
    """Check that a retrieval keeps :class:`groma.features.contract.ImageRetrieval`.

    An image is most like itself, then like the view from a step beside it, then like its mirror image; a number for
    each other image, all finite, none for none.

    Raises
    ------
    AssertionError
        If one of these does not hold.
    """
    name, image = type(retrieval).__name__, picture()
    others = [retrieval.describe(other) for other in (image[:, ::-1].copy(), picture(_SHIFT), image)]
    alike = np.asarray(retrieval.similarity(retrieval.describe(image), others))
    require(alike.shape == (3,), name, f"similarity() must return one number an image; got {alike.shape} for 3")
    require(bool(np.isfinite(alike).all()), name, f"similarities must be finite; got {alike}")
    require(bool(alike[2] >= alike[1] > alike[0]), name, f"mirror image, view beside, same image: got {alike}")
    require(np.shape(retrieval.similarity(others[0], [])) == (0,), name, "no images must give no numbers")
