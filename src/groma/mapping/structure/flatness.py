# SPDX-License-Identifier: BSD-3-Clause
r"""How flat the planes of a scene are: the distances that points and lines keep from them beyond their own noise.

The height h of a landmark over its plane has two sources of variance: the landmark's own, :math:`s^2`, known from its
observations, and that of the surface: plaster, joints, frames. The scene has one standard deviation t of its surfaces,
expressed in pixels; with :math:`\ell` the length of a pixel at the landmark,

.. math:: -2\log L(t) = \sum_i \log(s_i^2 + t^2\ell_i^2) + \frac{h_i^2}{s_i^2 + t^2\ell_i^2} + \text{const}.

Fitting a plane to n landmarks uses three degrees of freedom, so heights are scaled by :math:`\sqrt{n/(n-3)}`, and
planes with three landmarks are left out. Too small a deviation forces landmarks onto a plane; too large a one gives the
plane no influence. The result is the upper end of the one-sigma confidence interval of t, which stays large where
landmarks are few or noisy.

A scene of floors and smooth boxes may have one wall with frames and panels before it. With cameras held, planes that
deviate more than those of the scene have a deviation of their own (:func:`with_rough_planes`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.adjustment.terms.relations import lengths_per_pixel
from groma.mapping.noise.landmarks import GATES as LANDMARK_GATES
from groma.mapping.noise.landmarks import LineNoise, PointNoise
from groma.mapping.structure.find import LandmarkNoise, StructureOptions, landmark_noise
from groma.scene import Scene

#: Deviations that are tried, each five per cent larger than the one before (cost: time).
_TRIED = 100
#: Unknowns of a plane (derived from geometry).
_UNKNOWNS = 3
#: Plane, height, variance and length of a pixel of landmarks.
_Heights = tuple[IntArray, FloatArray, FloatArray, FloatArray]
_NOTHING: _Heights = np.zeros(0, np.int64), np.zeros(0), np.zeros(0), np.zeros(0)


def surface_noise_px(scene: Scene, options: StructureOptions, noise: LandmarkNoise | None = None) -> float:
    """Return the standard deviation of landmarks from the planes that they lie on, as a length in the images, pixels.

    Parameters
    ----------
    scene : Scene
        Landmarks with their observations, and the planes and relations that were found in them.
    options : StructureOptions
        What they were found with. No more than its ``surface_sigma_px`` is returned, and that where nothing is on a
        plane.
    noise : optional
        :func:`~groma.mapping.structure.find.landmark_noise` of the scene, where it is known already.
    """
    plane, height, variance, length = _heights(scene, noise or landmark_noise(scene, options))
    count = np.bincount(plane, minlength=scene.num_planes)[plane]
    told = count > _UNKNOWNS
    squared = height[told] ** 2 * count[told] / (count[told] - _UNKNOWNS)
    return _upper_end(squared, variance[told], length[told], options.surface_sigma_px)


def plane_noise_px(scene: Scene, options: StructureOptions, noise: LandmarkNoise | None = None) -> FloatArray:
    """Return the same (K,) of each plane on its own; the most where three landmarks or fewer lie on it.

    Parameters are those of :func:`surface_noise_px`.
    """
    plane, height, variance, length = _heights(scene, noise or landmark_noise(scene, options))
    count = np.bincount(plane, minlength=scene.num_planes)
    out = np.full(scene.num_planes, options.surface_sigma_px)
    for k in np.flatnonzero(count > _UNKNOWNS):
        of = plane == k
        squared = height[of] ** 2 * count[k] / (count[k] - _UNKNOWNS)
        out[k] = _upper_end(squared, variance[of], length[of], options.surface_sigma_px)
    return out


def with_rough_planes(scene: Scene, sigma_px: float, options: StructureOptions, noise: LandmarkNoise) -> Scene:
    """Return the scene with the deviation of each plane that deviates by more than ``sigma_px`` in its relations.

    Relations that have a deviation keep it. The other parameters are those of :func:`surface_noise_px`.
    """
    own, relations = plane_noise_px(scene, options, noise), scene.relations
    sigmas = {}
    for kind, of in (("point_on_plane", "point"), ("line_on_plane", "line")):
        landmark, plane = getattr(relations, kind).T
        sigma, length = relations.sigma(kind), lengths_per_pixel(scene, of)
        rough = (sigma == 0.0) & (own[plane] > sigma_px)
        sigmas[f"{kind}_sigma"] = np.where(rough, own[plane] * length[landmark], sigma)
    return scene.replace(relations=replace(relations, **sigmas))


def _upper_end(squared: FloatArray, variance: FloatArray, length: FloatArray, most: float) -> float:
    """Upper end of the confidence interval of t, from scaled squares of heights, up to the most."""
    tried = np.geomspace(min(LANDMARK_GATES.min_sigma_px, most), most, _TRIED)
    surprise = np.empty(_TRIED)
    for k, sigma in enumerate(tried):
        total = variance + (sigma * length) ** 2
        surprise[k] = (np.log(total) + squared / total).sum()
    return float(tried[np.flatnonzero(surprise <= surprise.min() + 1.0)[-1]])


def _heights(scene: Scene, noise: LandmarkNoise) -> _Heights:
    """Of points and of the ends of lines on planes."""
    points, lines = _of_points(scene, noise[0]), _of_lines(scene, noise[1])
    plane, height = np.concatenate([points[0], lines[0]]), np.concatenate([points[1], lines[1]])
    return plane, height, np.concatenate([points[2], lines[2]]), np.concatenate([points[3], lines[3]])


def _of_points(scene: Scene, noise: PointNoise) -> _Heights:
    """Planes of points, heights over them, their own variances, and the length of a pixel there."""
    if len(scene.relations.point_on_plane) == 0:
        return _NOTHING
    common = scene.relations.sigma("point_on_plane") == 0.0  # others have a deviation of their own
    point, plane = scene.relations.point_on_plane[common].T
    normal, offset = scene.planes.hesse[plane, :3], scene.planes.hesse[plane, 3]
    covariance = noise.covariance[point]
    variance = np.einsum("ni,nij,nj->n", normal, covariance, normal)
    height = np.einsum("ni,ni->n", scene.points.xyz[point], normal) + offset
    return plane, height, variance, lengths_per_pixel(scene, "point")[point]


def _of_lines(scene: Scene, noise: LineNoise) -> _Heights:
    """The same of both ends of lines."""
    if len(scene.relations.line_on_plane) == 0:
        return _NOTHING
    line, plane = scene.relations.line_on_plane[scene.relations.sigma("line_on_plane") == 0.0].T
    normal, offset = scene.planes.hesse[plane, :3], scene.planes.hesse[plane, 3]
    slope = np.einsum("nai,ni->na", noise.across[line], normal)
    blocks = noise.covariance[line].reshape(-1, 2, 2, 2, 2)
    variance = np.einsum("na,neaeb,nb->ne", slope, blocks, slope)
    height = np.einsum("nei,ni->ne", scene.lines.segments[line], normal) + offset[:, None]
    length = np.repeat(lengths_per_pixel(scene, "line")[line], 2)
    return np.repeat(plane, 2), height.ravel(), variance.ravel(), length
