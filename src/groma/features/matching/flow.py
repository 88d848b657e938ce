# SPDX-License-Identifier: BSD-3-Clause
"""Match segments between neighbouring images of a sequence, or a stereo pair, by dense optical flow.

Points every few pixels along a segment are carried to the other image by the flow. Those that the backward flow does
not carry home are dropped (they are hidden there, or the flow is wrong). The others vote for the segment they arrive
at: the nearest one, if it is near enough and runs the same way, dark side included. The share of a segment's points
that voted for a partner is taken from both sides; both must be enough, and the pair must be best for both.

The flow is OpenCV's DIS (Kroeger et al., *Fast optical flow using dense inverse search*, 2016), on the CPU.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from groma._rows import numbered
from groma._trees import kd_tree
from groma._typing import FloatArray, IntArray
from groma.errors import InputError, ShapeError, given_or_default
from groma.features.images import GrayImage, to_gray
from groma.features.matches import LineMatches, mutual_best
from groma.features.segments import Segments

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Flow = npt.NDArray[np.float32]
#: Smaller images give DIS no patch to compare, pixels (derived from its patches of 8, in an image of half the size).
MIN_IMAGE = 16


@dataclass(frozen=True)
class FlowOptions:
    """What counts as a match."""

    #: Distance of the points along a segment, pixels.
    step: float = 3.0
    #: Maximum forward-backward error, pixels.
    round_trip: float = 2.0
    #: A point votes for a segment within this distance, pixels.
    max_distance: float = 3.0
    #: Largest angle between a segment and the path of its points in the other image, radians.
    max_angle: float = 0.2
    #: Smallest share of votes.
    min_score: float = 0.4
    #: By which share of the score a match must beat any rival.
    margin: float = 0.1


def dense_flow(image_1: npt.NDArray[np.generic], image_2: npt.NDArray[np.generic]) -> Flow:
    """Dense flow (H, W, 2) in pixels from the first image to the second, which must have the same size."""
    one, two = _pair(image_1, image_2)
    if min(one.shape) < MIN_IMAGE:
        return np.zeros((*one.shape, 2), dtype=np.float32)
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    found = flow.calc(one, two, None)  # pyright: ignore[reportCallIssue, reportArgumentType]
    return np.asarray(found, dtype=np.float32)


def match_by_flow(
    image_1: npt.NDArray[np.generic],
    image_2: npt.NDArray[np.generic],
    segments_1: Segments,
    segments_2: Segments,
    options: FlowOptions | None = None,
    flows: tuple[Flow, Flow] | None = None,
) -> LineMatches:
    """Match segments by a vote of dense flow along them, checked forward and backward.

    Parameters
    ----------
    image_1, image_2 : (H, W) or (H, W, 3) uint8
        Images of the same size.
    segments_1, segments_2 : Segments
        Their segments.
    options : FlowOptions, optional
        Thresholds.
    flows : two (H, W, 2) float32, optional
        Flow from first to second and back, where the caller has them; otherwise computed here.

    Returns
    -------
    LineMatches
        One to one; the score is the geometric mean of the two shares of votes.

    Raises
    ------
    ShapeError
        If the images differ in size, or a flow does not have that size.
    """
    options = given_or_default(options, FlowOptions)
    if options.step <= 0.0 or options.max_distance <= 0.0:
        raise InputError(f"step and max_distance must be positive; got {options.step} and {options.max_distance}.")
    one, two = _pair(image_1, image_2)
    if not len(segments_1) or not len(segments_2):
        return LineMatches.empty()
    forward, backward = flows if flows is not None else (dense_flow(one, two), dense_flow(two, one))
    for flow in (forward, backward):
        if flow.shape != (*one.shape, 2):
            raise ShapeError(f"A flow must have shape {(*one.shape, 2)}, one vector a pixel; got {flow.shape}.")
    there = _votes(segments_1, segments_2, forward, backward, options)
    both = there.multiply(_votes(segments_2, segments_1, backward, forward, options).T.tocsr()).tocoo()
    score = np.sqrt(both.data)
    good = score >= options.min_score
    first, second = both.row[good].astype(np.int64), both.col[good].astype(np.int64)
    margin = -float(np.log1p(-options.margin))
    return mutual_best(first, second, score[good], np.log(score[good]), segments_1, segments_2, margin)


def _pair(image_1: npt.NDArray[np.generic], image_2: npt.NDArray[np.generic]) -> tuple[GrayImage, GrayImage]:
    one, two = to_gray(image_1), to_gray(image_2)
    if one.shape != two.shape:
        raise ShapeError(
            f"Images matched by flow must have the same size; got {one.shape} and {two.shape}. "
            "Use match_wide_baseline for images of different cameras."
        )
    return one, two


def _along(segments: Segments, step: float) -> tuple[FloatArray, IntArray]:
    """Points along all segments (S, 2), at most `step` apart, and the segment each belongs to."""
    count = np.maximum(np.ceil(segments.length / step), 2).astype(np.int64)
    owner, place = numbered(count)
    t = ((place + 0.5) / count[owner])[:, None]
    ends = segments.ends[owner]
    return (1.0 - t) * ends[:, :2] + t * ends[:, 2:], owner


def _sample(flow: Flow, points: FloatArray) -> FloatArray:
    """Flow (S, 2) at points in pixels, bilinear."""
    rows = np.ascontiguousarray(points - 0.5, dtype=np.float32)
    # cv2.remap wants maps narrower than 32768: fold the list into a sheet.
    width = 1024
    sheet = np.zeros((-(-len(rows) // width) * width, 2), dtype=np.float32)
    sheet[: len(rows)] = rows
    sheet = sheet.reshape(-1, width, 2)
    nothing = np.zeros(0, dtype=np.float32)
    sampled = cv2.remap(flow, sheet, nothing, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return sampled.reshape(-1, 2)[: len(rows)].astype(np.float64)


def _votes(source: Segments, target: Segments, forward: Flow, backward: Flow, options: FlowOptions) -> csr_array:
    """Share (N1, N2) of the points of each source segment that vote for each target segment."""
    points, owner = _along(source, options.step)
    total = np.bincount(owner, minlength=len(source))
    arrived = points + _sample(forward, points)
    returned = arrived + _sample(backward, arrived)
    height, width = forward.shape[:2]
    ok = ((arrived >= 0.0) & (arrived <= (width, height))).all(axis=1)
    ok &= np.linalg.norm(returned - points, axis=1) <= options.round_trip
    # How the carried points run: difference to the next point of the same segment, else from the one before.
    path = np.zeros_like(arrived)
    path[:-1] = np.where((owner[1:] == owner[:-1])[:, None], arrived[1:] - arrived[:-1], 0.0)
    last = np.append(owner[1:] != owner[:-1], True)
    path[last] = np.roll(path, 1, axis=0)[last]
    # A segment's path as a whole is steadier than that of one point.
    heading = np.stack([np.bincount(owner, path[:, k] * ok, len(source)) for k in (0, 1)], axis=1)
    norm = np.linalg.norm(heading, axis=1, keepdims=True)
    heading = heading / np.where(norm > 0.0, norm, np.inf)

    ends_at, target_of = _along(target, 2.0)
    tree = kd_tree(ends_at)
    rows = np.flatnonzero(ok)
    # The nearest few pieces: where two edges run side by side, only the one that runs the same way gets the vote.
    reach = np.hypot(options.max_distance, 1.0)
    num_near = max(2, min(4, len(ends_at)))  # `target` has at least two pieces
    near = np.asarray(tree.query(arrived[rows], k=num_near, distance_upper_bound=reach)[1]).reshape(len(rows), num_near)
    found = near < len(ends_at)
    candidate = target_of[np.where(found, near, 0)]
    line = target.line[candidate]
    distance = np.abs((line[..., :2] * arrived[rows][:, None]).sum(axis=-1) + line[..., 2])
    aligned = (target.direction[candidate] * heading[owner[rows]][:, None]).sum(axis=-1) >= np.cos(options.max_angle)
    distance[~(found & aligned & (distance <= options.max_distance))] = np.inf
    pick = np.argmin(distance, axis=1)
    voted = np.isfinite(distance[np.arange(len(rows)), pick])
    voter, choice = owner[rows][voted], candidate[np.arange(len(rows)), pick][voted]
    from scipy.sparse import coo_array  # takes a quarter of a second to import

    counts = coo_array((np.ones(len(voter)), (voter, choice)), shape=(len(source), len(target))).tocsr()
    counts.sum_duplicates()
    counts.data /= total[np.repeat(np.arange(len(source)), np.diff(counts.indptr))]
    return counts
