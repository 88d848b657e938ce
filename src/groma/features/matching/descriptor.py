# SPDX-License-Identifier: BSD-3-Clause
r"""Describe segments by the gradients in bands parallel to them.

The support region is as long as the segment and made of rows parallel to it, one pixel apart. In a row, four numbers
are averaged over the length: the positive and the negative part of the gradient across the segment, and the same
along it. Rows are gathered in bands; a band gives the mean and the standard deviation, over its rows and half of its
neighbours', of these four. With 9 bands the descriptor has 72 numbers.

Gradients ignore an added brightness; the final normalisation ignores contrast; averaging over the length makes the
descriptor independent of it, and of where exactly the end points fell. Means and deviations are normalised
separately, so that neither drowns the other, large entries are cut at 0.4 (one strong edge must not decide alone), and
the whole has norm 1. Distances therefore lie between 0 and 2.

References
----------
L. Zhang, R. Koch, *An efficient and robust line segment matching approach based on LBD descriptor and pairwise
geometric consistency*, 2013, sections 3.1 and 3.2. Deviations: one scale chosen by the caller instead of octaves,
triangular weights over rows, averages in place of sums, samples at a bounded number of places along the segment.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from groma._numba import kernel, loop
from groma.errors import InputError
from groma.features.images import to_gray
from groma.features.segments import Segments
from groma.gates import STRECHA, gate

Descriptors = npt.NDArray[np.float32]
#: Bands beside a segment, with eight numbers each (convention: LBD, Zhang and Koch 2013).
BANDS = 9
DESCRIPTOR_SIZE = 8 * BANDS  # convention: as above


@dataclass(frozen=True)
class DescriptorGates:
    """How the surroundings of a segment are described."""

    max_entry: float = gate(0.4, "1", "entries of the unit vector are cut here", "convention: LBD, Zhang and Koch 2013")
    max_samples: int = gate(48, "samples", "samples along a segment", "cost: time per segment")
    fade: float = gate(0.6, "share", "deviation of the weight of rows, of the half width", STRECHA)
    overlap: float = gate(1.25, "bands", "half width of the weight of rows in a band", "chosen on Strecha's scenes")
    min_blur: float = gate(0.7, "px", "least standard deviation of the blur", "derived from sampling by pixels")


#: The defaults.
DESCRIPTORS = DescriptorGates()


# -------------------------------------------------------------------------------------------------------- Kernels
@kernel
def _row(gradient_u, gradient_v, u, v, du, dv, count, nu, nv, out):
    """Mean positive and negative gradient across and along one row of `count` samples; nearest pixels."""
    height, width = gradient_u.shape
    plus_across = 0.0
    minus_across = 0.0
    plus_along = 0.0
    minus_along = 0.0
    seen = 0
    for k in range(count):
        t = (k + 0.5) / count
        j, i = math.floor(u + t * du), math.floor(v + t * dv)
        if i < 0 or j < 0 or i >= height or j >= width:
            continue
        seen += 1
        gu, gv = gradient_u[i, j], gradient_v[i, j]
        across, along = gu * nu + gv * nv, gu * nv - gv * nu
        plus_across += max(across, 0.0)
        minus_across += max(-across, 0.0)
        plus_along += max(along, 0.0)
        minus_along += max(-along, 0.0)
    share = 1.0 / max(seen, 1)
    out[0], out[1], out[2], out[3] = plus_across * share, minus_across * share, plus_along * share, minus_along * share


@loop
def _describe_all(gradient_u, gradient_v, ends, band_rows, step, max_samples, fade, overlap, out):
    """Raw band statistics: out (N, 72), means of the bands first, then deviations."""
    num_rows = BANDS * band_rows
    rows = np.zeros((num_rows, 4))
    for n in range(ends.shape[0]):
        u1, v1 = ends[n, 0], ends[n, 1]
        du, dv = ends[n, 2] - u1, ends[n, 3] - v1
        length = max(math.hypot(du, dv), 1e-9)
        nu, nv = -dv / length, du / length
        count = min(max(int(length), 4), max_samples)
        for r in range(num_rows):
            offset = (r - 0.5 * (num_rows - 1)) * step
            _row(gradient_u, gradient_v, u1 + offset * nu, v1 + offset * nv, du, dv, count, nu, nv, rows[r])
            # Rows far from the segment have less weight: they may be on another surface.
            far = 2.0 * offset / (num_rows * step)
            weight = math.exp(-0.5 * (far / fade) ** 2)
            for c in range(4):
                rows[r, c] *= weight
        for band in range(BANDS):
            center = (band + 0.5) * band_rows - 0.5
            for c in range(4):
                total = 0.0
                first = 0.0
                second = 0.0
                for r in range(max((band - 1) * band_rows, 0), min((band + 2) * band_rows, num_rows)):
                    w = 1.0 - abs(r - center) / (overlap * band_rows)
                    if w <= 0.0:
                        continue
                    total += w
                    first += w * rows[r, c]
                    second += w * rows[r, c] * rows[r, c]
                mean = first / total
                out[n, band * 4 + c] = mean
                out[n, 4 * BANDS + band * 4 + c] = math.sqrt(max(second / total - mean * mean, 0.0))


# --------------------------------------------------------------------------------------------------------- Public
def describe(image: npt.NDArray[np.generic], segments: Segments, band_rows: int = 5, scale: float = 1.0) -> Descriptors:
    """Gradient-band descriptors of segments.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) uint8
        The image the segments are from.
    segments : Segments
        N segments.
    band_rows : int
        Rows in each of the 9 bands.
    scale : float
        Distance of the rows in pixels. To compare an image with one that shows things s times larger, describe the
        larger at scale s.

    Returns
    -------
    (N, 72) float32
        Unit vectors; zero where the surroundings have no gradient at all.

    Raises
    ------
    InputError
        If `band_rows` or `scale` is not positive.
    """
    if band_rows < 1 or not (math.isfinite(scale) and scale > 0.0):
        raise InputError(f"band_rows and scale must be positive; got {band_rows} and {scale}. Defaults are 5 and 1.")
    gray = to_gray(image)
    raw = np.zeros((len(segments), DESCRIPTOR_SIZE), dtype=np.float64)
    if len(segments):
        blur = max(scale, DESCRIPTORS.min_blur)
        smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), blur, borderType=cv2.BORDER_REPLICATE)
        gradient_u = cv2.Scharr(smooth, cv2.CV_32F, 1, 0, borderType=cv2.BORDER_REPLICATE)
        gradient_v = cv2.Scharr(smooth, cv2.CV_32F, 0, 1, borderType=cv2.BORDER_REPLICATE)
        _describe_all(
            gradient_u,
            gradient_v,
            segments.ends,
            band_rows,
            float(scale),
            DESCRIPTORS.max_samples,
            DESCRIPTORS.fade,
            DESCRIPTORS.overlap,
            raw,
        )
    half = DESCRIPTOR_SIZE // 2
    parts = np.concatenate([_unit(raw[:, :half]), _unit(raw[:, half:])], axis=1)
    return _unit(np.minimum(_unit(parts), DESCRIPTORS.max_entry)).astype(np.float32)


def _unit(vectors: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    norm = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(norm > 1e-9, norm, np.inf)
