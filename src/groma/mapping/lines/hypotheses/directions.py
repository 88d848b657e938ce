# SPDX-License-Identifier: BSD-3-Clause
r"""The change of depth along each segment, from the vanishing points of its image.

A segment whose line has direction d, with rays :math:`f_1, f_2` of its ends and :math:`n = f_1 \times f_2`, satisfies
:math:`f_2/q_2 - f_1/q_1 \parallel d`, so the inverse depths have a known ratio,

.. math:: r = \frac{q_2}{q_1} = \frac{n^\top (f_2 \times d)}{n^\top (f_1 \times d)}, \qquad
          \sigma_r = \sigma_d\,\frac{\|n \times f_2 - r\,n \times f_1\|}{|n^\top (f_1 \times d)|}

One known point on the segment then determines its place, and two views that share a short part of it determine it
better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from groma import cameras as camera_models
from groma._typing import FloatArray
from groma.execution import map_work
from groma.features.segments import Segments
from groma.features.vanishing_points import find_vanishing_points
from groma.gates import LINE_MAPS, SEARCH, gate
from groma.geometry import quaternion
from groma.mapping.lines.views import LineViews
from groma.scene import Scene


@dataclass(frozen=True)
class DirectionGates:
    """Which segments tell vanishing points, and which vanishing points tell depth."""

    num_voters: int = gate(200, "segments", "longest of an image, that look for vanishing points", SEARCH)
    min_voters: int = gate(10, "segments", "fewer tell no vanishing point", "chosen on benchmarks/lines.py")
    max_sigma: float = gate(0.01, "rad", "of a direction that tells something", LINE_MAPS)


GATES = DirectionGates()


def depth_ratios(scene: Scene, segments: Sequence[Segments], views: LineViews) -> FloatArray:
    """Ratio q2 / q1 of each segment and its standard deviation, (S, 2); zero without a vanishing point."""
    work = []
    for i in range(scene.num_images):
        rows, camera = views.rows(i), scene.images.camera_idx[i]
        chosen = views.usable_rows(i) - rows.start
        chosen = chosen[np.argsort(-views.length[rows][chosen], kind="stable")[: GATES.num_voters]]
        model = camera_models.model(scene.cameras.models[camera]), scene.cameras.params_of(camera)
        work.append((segments[i].select(chosen), chosen, views.ray[rows], scene.cam_from_world[i, :4], model))
    return np.concatenate([np.zeros((0, 2)), *map_work(_ratios_in, work)])


def _ratios_in(image: tuple) -> FloatArray:
    """The same of one image, from its longest segments, which they are, and the rays of all."""
    longest, chosen, ray, cam_from_world, (model, params) = image
    ratios = np.zeros((len(ray), 2))
    if len(chosen) < GATES.min_voters:
        return ratios
    found = find_vanishing_points(longest.ends, longest.sigma, model, params)
    with_one = found.label >= 0
    label, here = found.label[with_one], chosen[with_one]
    sigma = np.sqrt(0.5 * np.trace(found.covariance, axis1=1, axis2=2))[label]
    direction = (found.directions @ quaternion.to_matrix(cam_from_world))[label]
    ratios[here] = _ratios(ray[here], direction, sigma)
    return ratios


def _ratios(ray: FloatArray, direction: FloatArray, sigma: FloatArray) -> FloatArray:
    first, second = ray[:, 0], ray[:, 1]
    normal = np.cross(first, second)
    below = (normal * np.cross(first, direction)).sum(1)
    above = (normal * np.cross(second, direction)).sum(1)
    usable = (above * below > 0.0) & (sigma < GATES.max_sigma)  # otherwise the line vanishes between its ends
    below = np.where(usable, below, 1.0)
    ratio = above / below
    slope = np.linalg.norm(np.cross(normal, second) - ratio[:, None] * np.cross(normal, first), axis=1)
    return np.where(usable[:, None], np.column_stack([ratio, sigma * slope / np.abs(below)]), 0.0)
