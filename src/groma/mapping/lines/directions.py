# SPDX-License-Identifier: BSD-3-Clause
r"""What the vanishing points of an image say about its segments: how the depth changes along them.

A segment whose line has direction d, with rays :math:`f_1, f_2` of its ends and :math:`n = f_1 \times f_2`, satisfies
:math:`f_2/q_2 - f_1/q_1 \parallel d`, so the inverse depths have a known ratio,

.. math:: r = \frac{q_2}{q_1} = \frac{n^\top (f_2 \times d)}{n^\top (f_1 \times d)}, \qquad
          \sigma_r = \sigma_d\,\frac{\|n \times f_2 - r\,n \times f_1\|}{|n^\top (f_1 \times d)|}

One known point on the segment then gives its place; two views that see little of a segment's length say more with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from groma import cameras as camera_models
from groma._typing import FloatArray
from groma.features.vanishing_points import find_vanishing_points
from groma.geometry import quaternion
from groma.mapping.lines.views import LineViews
from groma.scene import Scene

if TYPE_CHECKING:
    from groma.features.segments import Segments

#: Segments per image that look for vanishing points, the longest; all may belong to one.
_NUM_VOTERS = 200
#: Directions less certain than this say nothing, radians.
_MAX_SIGMA = 0.01


def depth_ratios(scene: Scene, segments: Sequence[Segments], views: LineViews) -> FloatArray:
    """Ratio q2 / q1 of each segment and its standard deviation, (S, 2); zero without a vanishing point."""
    ratios = np.zeros((len(views.image_idx), 2))
    rotation = quaternion.to_matrix(scene.cam_from_world[:, :4])
    for i in range(scene.num_images):
        rows = np.arange(views.pointers[i], views.pointers[i + 1])
        chosen = np.flatnonzero(views.usable[rows])
        chosen = chosen[np.argsort(-views.length[rows[chosen]], kind="stable")[:_NUM_VOTERS]]
        if len(chosen) < 10:
            continue
        camera = scene.images.camera_idx[i]
        model, params = camera_models.model(scene.cameras.models[camera]), scene.cameras.params_of(camera)
        found = find_vanishing_points(segments[i].ends[chosen], segments[i].sigma[chosen], model, params)
        with_one = found.label >= 0
        label = found.label[with_one]
        sigma = np.sqrt(0.5 * np.trace(found.covariance, axis1=1, axis2=2))[label]
        here = rows[chosen[with_one]]
        ratios[here] = _ratios(views.ray[here], (found.directions @ rotation[i])[label], sigma)
    return ratios


def _ratios(ray: FloatArray, direction: FloatArray, sigma: FloatArray) -> FloatArray:
    first, second = ray[:, 0], ray[:, 1]
    normal = np.cross(first, second)
    below = (normal * np.cross(first, direction)).sum(1)
    above = (normal * np.cross(second, direction)).sum(1)
    usable = (above * below > 0.0) & (sigma < _MAX_SIGMA)  # otherwise the line vanishes between its ends
    below = np.where(usable, below, 1.0)
    ratio = above / below
    slope = np.linalg.norm(np.cross(normal, second) - ratio[:, None] * np.cross(normal, first), axis=1)
    return np.where(usable[:, None], np.column_stack([ratio, sigma * slope / np.abs(below)]), 0.0)
