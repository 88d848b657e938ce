# SPDX-License-Identifier: BSD-3-Clause
"""The built-in segment matchers under their contract, :class:`groma.features.contract.SegmentMatcher`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from groma._typing import FloatArray
from groma.features.contract import ImageView
from groma.features.matches import LineMatches
from groma.features.matching.descriptor import Descriptors, describe
from groma.features.matching.flow import FlowOptions, match_by_flow
from groma.features.matching.nearby import NearbyPoints, nearby_points
from groma.features.matching.wide_baseline import WideBaselineOptions, fundamental_from_poses, match_wide_baseline
from groma.features.segments import Segments
from groma.geometry import quaternion


@dataclass(frozen=True, eq=False)
class DescribedImage:
    """What :class:`WideBaselineMatcher` needs of one image."""

    #: Segments without distortion.
    segments: Segments
    descriptors: Descriptors
    nearby: NearbyPoints
    #: (3, 3) camera matrix, and (3, 4) pose cam_from_world where it is known.
    camera_matrix: FloatArray
    pose: FloatArray | None


@dataclass(frozen=True)
class WideBaselineMatcher:
    """Matches by surroundings, shared points and the epipolar geometry of known poses."""

    options: WideBaselineOptions = field(default_factory=WideBaselineOptions)

    def describe(self, view: ImageView) -> DescribedImage:
        """Describe the surroundings of the segments of an image, and find the points near them."""
        segments, model, params = view.segments, view.camera_model, view.camera_params
        # Segments without an undistorted image stay where they are; mapping does not use them.
        straight = model.undistort_pixels(params, segments.ends.reshape(-1, 2)).reshape(-1, 4)
        straight = np.where(np.isfinite(straight).all(1, keepdims=True), straight, segments.ends)
        near = nearby_points(segments, view.point_pixels, view.point_ids, self.options.reach)
        ideal = replace(segments, ends=straight)
        pose = view.cam_from_world
        if pose is not None:
            pose = np.column_stack([quaternion.to_matrix(pose[:4]), pose[4:]])
        return DescribedImage(ideal, describe(view.image, segments), near, model.camera_matrix(params), pose)

    def match(self, first: DescribedImage, second: DescribedImage) -> LineMatches:
        """Match two described images."""
        known = None
        if first.pose is not None and second.pose is not None:
            F = fundamental_from_poses(first.pose, second.pose, first.camera_matrix, second.camera_matrix)
            known = F if np.abs(F).max() > 0.0 else None
        described = first.descriptors, second.descriptors
        near = first.nearby, second.nearby
        return match_wide_baseline(first.segments, second.segments, *described, near, known, self.options)


@dataclass(frozen=True)
class FlowMatcher:
    """Matches by dense optical flow, for images of a sequence; images of different size have no matches."""

    options: FlowOptions = field(default_factory=FlowOptions)

    def describe(self, view: ImageView) -> ImageView:
        """Return the view itself."""
        return view

    def match(self, first: ImageView, second: ImageView) -> LineMatches:
        """Match two images."""
        if first.image.shape != second.image.shape:
            return LineMatches.empty()
        return match_by_flow(first.image, second.image, first.segments, second.segments, self.options)
