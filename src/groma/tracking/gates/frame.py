# SPDX-License-Identifier: BSD-3-Clause
"""Numbers of what one frame gives: checks, turns, depth, planes, the right image."""

from __future__ import annotations

from dataclasses import dataclass

from groma.gates import SEQUENCES, gate


@dataclass(frozen=True)
class CheckGates:
    """Frames that are of no use."""

    sparse_depth: float = gate(0.2, "share", "known depths; fewer are reported", "convention: a sentence only")


@dataclass(frozen=True)
class TurnGates:
    """Turns between two frames, from small images."""

    width: int = gate(64, "px", "width of the small images", SEQUENCES + " and rendered turns")
    steps: int = gate(12, "steps", "Gauss-Newton steps of an alignment", "cost: converges in fewer")
    min_overlap: float = gate(0.25, "share", "smallest overlap of two aligned images", SEQUENCES)
    outlier: float = gate(3.0, "medians", "of a robust weight of grey levels", "derived from normal noise: 2 sigma")
    converged: float = gate(0.02, "px", "a smaller step ends an alignment", "cost: a tenth of what it is good for")
    agrees: float = gate(0.8, "correlation", "a prediction that agrees so well needs no help", SEQUENCES)
    gain: float = gate(0.04, "correlation", "by how much a turn must agree better than a prediction", SEQUENCES)
    min_places: int = gate(8, "places", "places that a judgement needs", SEQUENCES)
    sigma: float = gate(0.03, "rad", "noise of a turn found so", SEQUENCES + " and rendered turns")


@dataclass(frozen=True)
class DepthGates:
    """Depth images: noise, and where the depth beside a segment is read."""

    inverse_sigma: float = gate(0.003, "1 / unit", "of inverse depth: 3 mm at 1 m", "derived from Kinect disparities")
    min_sigma: float = gate(0.003, "scene units", "a depth is not known better", "derived from millimetres in files")
    near: float = gate(0.5, "px", "depth beside a segment is read from this distance on", SEQUENCES)
    far: float = gate(4.5, "px", "and up to this distance, so that narrow faces are not missed", SEQUENCES)
    min_images: int = gate(8, "images", "that tell an offset of depths", "derived from a variance good to a half")
    max_misfit: float = gate(2.0, "ratio", "noise of depths to that stated that is told", "convention: a sentence only")
    grid: int = gate(20, "px", "distance of the places whose depth is kept, and on planes", "cost: 768 in 640 x 480")
    far_share: float = gate(0.25, "share", "largest noise of a stereo depth; far points serve, too", SEQUENCES)


@dataclass(frozen=True)
class SparseDepthGates:
    """Depth images that are mostly holes, and how they are filled."""

    dense: float = gate(0.35, "share", "images with more known depths are left alone", SEQUENCES)
    cell: int = gate(4, "px", "side of a cell", SEQUENCES)
    window: int = gate(11, "cells", "side of a window", SEQUENCES)
    min_samples: int = gate(12, "samples", "samples in a window", SEQUENCES)
    max_scatter: float = gate(2.5, "sigma", "largest deviation of samples from their plane", SEQUENCES)
    max_reading: float = gate(2.0, "sigma", "largest deviation of a reading between samples", SEQUENCES)


@dataclass(frozen=True)
class FramePlaneGates:
    """Planes in one depth image."""

    correlation: float = gate(100.0, "samples", "neighbouring samples that err alike count as one", SEQUENCES)
    tilt: float = gate(0.004, "rad", "no plane is known better: depth cameras bend planes", SEQUENCES)
    min_share: float = gate(0.015, "share", "smallest share of the image on a plane", SEQUENCES)
    max_planes: int = gate(10, "planes", "planes of one frame", "cost: frames show fewer")
    min_places: int = gate(8, "places", "places on a plane; thin strips have fewer", SEQUENCES)


@dataclass(frozen=True)
class StereoGates:
    """Columns of points in the right image."""

    disparity_sigma: float = gate(0.5, "px", "standard deviation of a disparity", "chosen on KITTI 06")
    block: int = gate(13, "px", "width of the compared blocks", "chosen on KITTI 06")
    max_disparity: float = gate(0.12, "share", "largest disparity, of the width of the image", "chosen on KITTI 06")
    uniqueness: int = gate(15, "percent", "margin over the second best block", "convention: OpenCV's default")
    texture: int = gate(8, "grey levels", "sum of gradients of a block that is matched at all", "chosen on KITTI 06")
    around: int = gate(6, "px", "a disparity is looked for within this distance", "chosen on KITTI 06")
    window: int = gate(17, "px", "width of the patches that refine a column", "chosen on KITTI 06")
    max_row: float = gate(1.5, "px", "distance of a point from its row: rectification errs", "chosen on KITTI 06")


@dataclass(frozen=True)
class RectificationGates:
    """How the right camera of a pair is turned."""

    sigma_deg: float = gate(0.1, "degree", "of each angle before anything is known", "derived from rectified sequences")
    band_deg: float = gate(0.5, "degree", "from their rows, where first pairs are searched", "derived from 5 sigma")
    keystone_deg: float = gate(2.0, "degree", "bound of keystones and rows", "derived from 20 sigma")
    num_features: int = gate(1500, "features", "described in each image of the first pairs", "cost: 0.1 seconds")
    max_disparity: float = gate(0.2, "share", "largest disparity, of the width of the image", "cost: search is wide")
    looks: int = gate(10, "pairs", "pairs that are asked until one shows enough", "cost: 0.1 seconds each")
    iterations: int = gate(15, "steps", "reweighted fits of rows", "cost: converges in fewer")
    cells: int = gate(8, "cells", "cells along the width, within which errors are alike", "chosen on KITTI 06")
    min_cells: int = gate(6, "cells", "that show points; three numbers are fitted", "derived from twice the numbers")
    min_pairs: int = gate(30, "points", "points found in both images", "derived from five a cell")
    min_keyframes: int = gate(2, "keyframes", "at which angles are first estimated", "cost: rows alone before")
    max_step: float = gate(0.22, "share", "of the depth between keyframes: patches slide", "chosen on KITTI 06")
    min_columns: int = gate(100, "points", "columns that tell yaw", "derived from thirty in each of two pairs, twice")
    min_views: int = gate(4, "keyframes", "that see a point whose columns count", "chosen on KITTI 06")
    max_iterations: int = gate(50, "steps", "steps of the adjustment that tells yaw", "cost: converges in fewer")
    growth: float = gate(1.5, "ratio", "of keyframes, at which angles are estimated anew", "cost: adds up")
    as_sure: float = gate(1.5, "ratio", "of variances of yaw that count as equal", "derived from 15 cells")
    start_over: float = gate(0.3, "px", "error in the right image; first landmarks are not kept", "chosen on KITTI 06")
    matters: float = gate(0.05, "px", "a smaller change in the right image is not worth adjusting anew", "cost: time")
    focal_share: float = gate(0.01, "share", "error of the focal length that is told", "convention: one per cent")
    focal_share_alone: float = gate(0.03, "share", "the same of one camera", "chosen on New Tsukuba: 1.5 % where right")
    focal_iterations: int = gate(10, "steps", "with a free focal length", "cost: more change a tenth of its sigma")


@dataclass(frozen=True)
class FeatureGates:
    """Described features."""

    fast_threshold: int = gate(7, "grey levels", "contrast of a corner (FAST)", SEQUENCES)
    candidates: int = gate(4, "ratio", "features found for each that is described", "cost: time per keyframe")
    cell: int = gate(32, "px", "described features are taken from cells of this side in turn", "chosen on EuRoC V1_01")
    max_bits: int = gate(
        64, "bits", "descriptors of a pair differ in at most so many of 256",
        "derived from chance: unlike descriptors differ in fewer once in 10^15",
    )  # fmt: skip
    max_bits_near: int = gate(75, "bits", "the same near where a feature is expected", SEQUENCES)
