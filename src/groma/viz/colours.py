# SPDX-License-Identifier: BSD-3-Clause
"""Colours of numbers, directions and groups."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.io.drawn import direction_of_lines
from groma.scene import Scene
from groma.scene.patches import PALETTE

Colours = npt.NDArray[np.uint8]

#: The ramp of all pictures of groma: blue is low, red is high.
RAMP = np.array([[44, 111, 187], [63, 182, 168], [232, 197, 58], [217, 71, 43]], float)
#: For what has no number.
GREY = np.array([150, 152, 156], np.uint8)


def ramp(share: npt.ArrayLike) -> Colours:
    """Colours (..., 3) of numbers from 0 to 1; numbers outside are clipped, NaN is grey."""
    value = np.asarray(share, float)
    known = np.isfinite(value)
    place = np.clip(np.where(known, value, 0.0), 0.0, 1.0) * (len(RAMP) - 1)
    left = np.minimum(place.astype(int), len(RAMP) - 2)
    part = (place - left)[..., None]
    colour = np.round(RAMP[left] * (1 - part) + RAMP[left + 1] * part).astype(np.uint8)
    return np.where(known[..., None], colour, GREY)


def of_group(group: IntArray) -> Colours:
    """Colours (..., 3) of groups 0, 1, ...; they repeat after eight; negative numbers are grey."""
    return np.where((group >= 0)[..., None], PALETTE[group % len(PALETTE)], GREY)


def of_lines(scene: Scene) -> Colours:
    """Colours (L, 3) of lines by their direction in the frame that most of their length follows."""
    vectors = scene.lines.plucker[:, 3:]
    frame = common_frame(vectors, np.linalg.norm(scene.lines.segments[:, 1] - scene.lines.segments[:, 0], axis=1))
    return of_direction(vectors @ frame.T)


def of_shared_directions(scene: Scene) -> Colours:
    """Colours (L, 3) of lines by the direction that they share with others; grey for those that share none."""
    return of_group(direction_of_lines(scene))


def common_frame(vectors: FloatArray, weights: FloatArray) -> FloatArray:
    r"""Return three axes at right angles (3, 3) that unit vectors (N, 3) of any sign follow, the heaviest first.

    .. math:: \max_{R \in O(3)} \sum_n w_n \|R\,d_n\|_4^4

    The fourth power is largest where vectors lie along axes. Each step replaces :math:`R` by the orthogonal matrix that
    is closest to the gradient, which never lowers the sum; of several starts the best counts.

    References
    ----------
    Zhai, Yang, Liao, Wright, Ma, *Complete dictionary learning via L4-norm maximization over the orthogonal group*,
    2020, algorithm 2.
    """
    known = np.isfinite(vectors).all(axis=1) & np.isfinite(weights)
    unit, weight = vectors[known], weights[known]
    if not weight.sum() > 0:
        return np.eye(3)
    starts = np.linalg.qr(np.random.default_rng(0).normal(size=(8, 3, 3)))[0]
    for _ in range(30):
        along = unit @ starts.transpose(0, 2, 1)
        left, _, right = np.linalg.svd((weight[:, None] * along * along * along).transpose(0, 2, 1) @ unit)
        starts = left @ right
    shares = np.einsum("n,sni->si", weight, (unit @ starts.transpose(0, 2, 1)) ** 4)
    best = int(np.argmax(shares.sum(axis=1)))
    return starts[best][np.argsort(-shares[best], kind="stable")]


#: Lines along the axes; a line this far from all of them, as the cosine, is grey.
_AXES = np.array([[208, 62, 48], [28, 112, 200], [34, 148, 84]], float)
_ALONG, _ASIDE = np.cos(np.deg2rad(6.0)), np.cos(np.deg2rad(25.0))


def of_direction(vectors: FloatArray) -> Colours:
    """Colours (N, 3) of unit vectors of any sign: red, blue, green along the first, second, third axis, else grey."""
    share = np.abs(vectors)
    nearest = np.argmax(share, axis=-1)
    along = np.clip((share.max(axis=-1) - _ASIDE) / (_ALONG - _ASIDE), 0.0, 1.0)[..., None]
    return np.round(along * _AXES[nearest] + (1.0 - along) * GREY).astype(np.uint8)


def css(colour: Colours) -> str:
    """One colour (3,) as ``#rrggbb``."""
    return "#{:02x}{:02x}{:02x}".format(*(int(channel) for channel in colour))
