# SPDX-License-Identifier: BSD-3-Clause
r"""How wrong a map is beside the noise of its landmarks: each image is localised in what the other images made.

Landmarks know the noise of the pixels that they were found from. They do not know the errors of poses, lens and depth:
those are common to the landmarks of a place, so that no number of them averages the error out. The poses of the images
of the map show it. Each is estimated from what the image sees without its own part in it
(:mod:`groma.localization.errors.left_out`); :math:`d_i` is how far that is from its pose in the map, :math:`P_i` the
covariance by noise and by errors that held poses are known to have, :math:`C_i` that by an error of one radian which
the landmarks of each cell of the image share. That error is the :math:`\tau` with which

.. math:: \operatorname{median}_i\; d_i^\top (P_i + \tau^2 C_i)^{-1} d_i

is the median of chi-square with six degrees of freedom; zero where noise alone explains the differences. What moves
all of a map alike, or bends it slowly, is not seen by this.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.execution import map_work
from groma.gates import chi_square_gate, gate
from groma.geometry import se3
from groma.localization.errors.left_out import without_image
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.hypotheses import max_errors
from groma.localization.pose.matches import Matches
from groma.localization.pose.refinement import refine


@dataclass(frozen=True)
class MapErrorGates:
    """Which images of a map are compared with the rest of it."""

    images: int = gate(32, "images", "compared at most, evenly chosen", "cost: of a pose each; it is good to a tenth")
    least: int = gate(3, "images", "that say something about the map", "derived from the median: it stands one wrong")
    matches: int = gate(10, "matches", "that such a pose is estimated from at least", "derived from 6 unknowns")


GATES = MapErrorGates()


@dataclass(frozen=True, eq=False)
class SeenByImage:
    """An image of a map and what it sees of it, with the deviations (pixels) that the landmarks were estimated with."""

    camera: QueryCamera
    matches: Matches
    pose: FloatArray
    #: (6, 6) covariance of what its pose is known to differ by from that by the others' landmarks, beside their noise.
    difference: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))


def images_compared(count: int) -> IntArray:
    """Return which of so many images are compared with the rest of their map."""
    return np.unique(np.round(np.linspace(0, count - 1, GATES.images)).astype(np.int64))


def shared_errors(
    images: Sequence[SeenByImage], progress: Callable[[int, int], None] | None = None, gates: MapErrorGates = GATES
) -> FloatArray:
    """Return (2,) what landmarks in one part of an image are off by together, radians as seen from it.

    The first is for poses from points alone, the second for poses from points and lines. Zero where there are too few
    images that landmarks are determined without.
    """
    found = map_work(_compared, images, progress)
    return np.array([_shared_error([pair[kind] for pair in found], gates) for kind in (0, 1)])


_Case = tuple[FloatArray, FloatArray, FloatArray]


def _compared(image: SeenByImage) -> tuple[_Case | None, _Case | None]:
    matches = without_image(image.camera, image.matches, image.pose)
    points = matches.take(np.ones(matches.num_points, bool), np.zeros(matches.num_lines, bool))
    return _case(replace(image, matches=points)), _case(replace(image, matches=matches))


def _case(image: SeenByImage) -> _Case | None:
    """Difference of two poses of an image, and its covariances by noise and by a shared error of one radian."""
    matches = image.matches
    if matches.num_points + matches.num_lines < GATES.matches:
        return None
    found = refine(image.camera, matches, image.pose, max_errors(matches))
    cell = found.cells(matches)
    noise = found.noise_covariance(cell)
    if not np.isfinite(noise).all():
        return None
    difference = se3.log(se3.compose(image.pose[None], se3.inverse(found.pose[None])))[0]
    return difference, noise + image.difference, found.shared_covariance(cell, matches.shared_error)


def _shared_error(cases: Sequence[_Case | None], gates: MapErrorGates) -> float:
    """The shared error that differences (6,) of poses show beside their noise."""
    known = [case for case in cases if case is not None]
    if len(known) < gates.least:
        return 0.0
    d, noise, shared = (np.stack(parts) for parts in zip(*known, strict=True))

    usual = chi_square_gate(0.5, 6)

    def median(square: float) -> float:
        return float(
            np.median(np.einsum("ni,ni->n", d, np.linalg.solve(noise + square * shared, d[..., None])[..., 0]))
        )

    if median(0.0) <= usual:
        return 0.0
    low, high = 0.0, 1e-12
    while median(high) > usual:
        low, high = high, 4.0 * high
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if median(middle) > usual else (low, middle)
    return float(np.sqrt(0.5 * (low + high)))
