# SPDX-License-Identifier: BSD-3-Clause
"""Statistics of lines: length, number of images, residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.scene import Scene
from groma.scene.line_intervals import supported_lengths
from groma.viz.drawable import Drawable, drawable, rms_by_group


@dataclass(frozen=True)
class LineStatistics:
    """Numbers of L lines and their M observations, in the order of the scene."""

    #: (L,) lengths of the intervals supported by images, scene units.
    length: FloatArray
    #: (L,) numbers of different images that observe them.
    num_images: IntArray
    #: (L,) root mean square distance of the measured ends from the image of the line, pixels; NaN where unobserved.
    residual_px: FloatArray
    #: (M, 2, 2) vector from each measured end to the image of the line, pixels; NaN where the line has none.
    end_residuals: FloatArray
    #: (M,) root mean square distance of the two ends of each observation, pixels.
    observation_residual_px: FloatArray


def line_statistics(scene: Scene, shown: Drawable | None = None) -> LineStatistics:
    r"""Compute the numbers of all lines at once.

    .. math:: r_l = \sqrt{\frac{1}{2 |O_l|} \sum_{o \in O_l} \sum_{e = 1}^{2} \|\Delta_{oe}\|^2}

    with the vectors :math:`\Delta` from the measured ends to the image of the line, perpendicular to it.

    Parameters
    ----------
    scene : Scene
        Lines and their observations.
    shown : Drawable, optional
        Result of :func:`groma.viz.drawable.drawable` for the same scene, if known.

    Returns
    -------
    LineStatistics
        Numbers by line and by observation.
    """
    shown = shown or drawable(scene)
    seen = scene.line_observations
    ends = shown.residuals[shown.residual_kind == shown.residual_kinds.index("line ends")].reshape(-1, 2, 2)
    far = np.sqrt(0.5 * np.einsum("mei,mei->m", ends, ends))
    return LineStatistics(
        length=supported_lengths(scene),
        num_images=images_of(seen.line_idx, seen.image_idx, scene.num_lines),
        residual_px=rms_by_group(far, seen.line_idx, scene.num_lines, empty=np.nan),
        end_residuals=ends,
        observation_residual_px=far,
    )


def images_of(landmark_idx: IntArray, image_idx: IntArray, num_landmarks: int) -> IntArray:
    """Return the number of distinct images that observe each landmark."""
    width = int(image_idx.max(initial=0)) + 1
    pairs = np.sort(landmark_idx.astype(np.int64) * width + image_idx)  # np.unique takes fifty times as long
    return np.bincount(pairs[np.diff(pairs, prepend=-1) > 0] // width, minlength=num_landmarks)
