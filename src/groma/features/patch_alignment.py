# SPDX-License-Identifier: BSD-3-Clause
r"""Find patches of one image in another to a few hundredths of a pixel: least-squares matching.

Keypoint detectors place each keypoint by itself; in good photographs the places of one physical point scatter by a
quarter of a pixel. The grey levels around them determine it better. A template T, cut from one image about a keypoint,
is aligned to another image I under an affine map and a gain and an offset of brightness,

.. math:: \min_{A, c, \alpha, \beta} \sum_x w(x)\, \big(\alpha\, I(c + A x) + \beta - T(x)\big)^2 ,

with x the place in the template relative to the keypoint and w a Gaussian window. The iteration is inverse
compositional: the increment is sought in the template, where its normal matrix is constant,

.. math:: s(x) = [\,g_u x^\top,\; g_v x^\top,\; g_u, g_v,\; T,\; 1\,], \qquad
          H = \sum_x w\, s s^\top + \Lambda, \qquad (\Delta A, \Delta c) = -H^{-1} \sum_x w\, s\, e ,

where :math:`g = \nabla T`, and the map becomes :math:`A (I + \Delta A)^{-1},\; c - A (I + \Delta A)^{-1} \Delta c`.
:math:`\Lambda` holds the increments of a shape that few grey levels determine near the given one.

Of the remaining differences' variance :math:`\sigma_e^2`, the place in the template has the covariance
:math:`\sigma_e^2 H^{-1}` (its two rows and columns), carried to the image by A.

Reference: S. Baker, I. Matthews, *Lucas-Kanade 20 Years On*, 2004, section 3.2 (inverse compositional), with the gain
and offset of A. Gruen, *Adaptive Least Squares Correlation*, 1985.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groma._numba import inline_kernel, kernel, loop
from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import ShapeError
from groma.gates import STRECHA, gate, numbers
from groma.geometry.algebra import as_rows

RADIUS = 7  # of the template, pixels
SIZE = 2 * RADIUS + 3  # side of a template, derived from the patch and one pixel more for its gradient
_SIDE = 2 * RADIUS + 1
_COUNT = _SIDE**2


@dataclass(frozen=True)
class PatchGates:
    """How a template is aligned."""

    spread: float = gate(4.0, "px", "standard deviation of the window", "chosen on Strecha's scenes")
    max_iterations: int = gate(20, "steps", "steps of an alignment", "cost: converges in fewer")
    step: float = gate(2e-3, "px", "a smaller step ends the alignment", "cost: a tenth of what it is good for")
    shape_sigma: float = gate(0.1, "1", "how far a step may turn, shear and stretch a patch without texture", STRECHA)
    unexplained: float = gate(0.01, "share", "of the contrast squared, that no template explains", STRECHA)
    min_texture: float = gate(1.0, "grey levels squared", "with less a template is left", "derived from camera noise")


#: The defaults.
PATCHES = PatchGates()


# -------------------------------------------------------------------------------------------------------- Kernels
@kernel
def _cubic_weights(f, w):
    """Catmull-Rom weights at the fraction f between the two middle ones of four samples."""
    w[0] = ((-0.5 * f + 1.0) * f - 0.5) * f
    w[1] = (1.5 * f - 2.5) * f * f + 1.0
    w[2] = ((-1.5 * f + 2.0) * f + 0.5) * f
    w[3] = (0.5 * f - 0.5) * f * f


@kernel
def _solve_in_place(H, n):
    """Invert the symmetric positive definite H by Gauss-Jordan steps; False where it is singular."""
    for k in range(n):
        pivot = H[k, k]
        if not pivot > 1e-12:
            return False
        for j in range(n):
            H[k, j] /= pivot
        H[k, k] = 1.0 / pivot
        for i in range(n):
            if i != k:
                factor = H[i, k]
                for j in range(n):
                    if j != k:
                        H[i, j] -= factor * H[k, j]
                H[i, k] = -factor / pivot
    return True


@loop
def _cut_all(image, pixels, templates, fractions):
    """Copy the surroundings of pixels; `fractions` is the keypoint relative to the middle of its template."""
    height, width = image.shape
    reach = RADIUS + 1
    for row in range(pixels.shape[0]):
        j, i = int(pixels[row, 0]), int(pixels[row, 1])
        if j < reach or i < reach or j >= width - reach or i >= height - reach:
            fractions[row, 0], fractions[row, 1] = math.nan, math.nan
            continue
        fractions[row, 0], fractions[row, 1] = pixels[row, 0] - j - 0.5, pixels[row, 1] - i - 0.5
        for v in range(SIZE):
            for u in range(SIZE):
                templates[row, v, u] = image[i + v - reach, j + u - reach]


@inline_kernel
def _describe(templates, number, fu, fv, window, S, T, W, H):
    """Write grey levels about their mean, their rows s(x), weights and H; return the sums of w and of w T^2."""
    total, mean = 0.0, 0.0
    for v in range(_SIDE):
        for u in range(_SIDE):
            k = v * _SIDE + u
            W[k] = window[u] * window[v]
            T[k] = templates[number, v + 1, u + 1]
            total += W[k]
            mean += W[k] * T[k]
    mean /= total
    squares = 0.0
    H[:, :] = 0.0
    for v in range(_SIDE):
        y = v - RADIUS - fv
        for u in range(_SIDE):
            x = u - RADIUS - fu
            k = v * _SIDE + u
            gu = 0.5 * (templates[number, v + 1, u + 2] - templates[number, v + 1, u])
            gv = 0.5 * (templates[number, v + 2, u + 1] - templates[number, v, u + 1])
            T[k] -= mean
            squares += W[k] * T[k] * T[k]
            S[k, 0], S[k, 1], S[k, 2], S[k, 3] = gu * x, gu * y, gv * x, gv * y
            S[k, 4], S[k, 5], S[k, 6], S[k, 7] = gu, gv, T[k], 1.0
            for a in range(8):
                for b in range(a + 1):
                    H[a, b] += W[k] * S[k, a] * S[k, b]
    return total, squares


@inline_kernel
def _invert_normal(H, noise, shape_sigma):
    """Complete H from its lower triangle, hold the shape, and invert it in place; False where it is singular."""
    for a in range(8):
        for b in range(a):
            H[b, a] = H[a, b]
    for a in range(4):
        H[a, a] += noise / shape_sigma**2
    return _solve_in_place(H, 8)


@inline_kernel
def _warp(image, A, c, fu, fv, W, wu, wv, warped):
    """Write the grey levels of the image under the map; return their weighted sum, NaN where it leaves the image."""
    height, width = image.shape
    weighted = 0.0
    for v in range(_SIDE):
        y = v - RADIUS - fv
        for u in range(_SIDE):
            x = u - RADIUS - fu
            pu, pv = c[0] + A[0] * x + A[1] * y, c[1] + A[2] * x + A[3] * y
            if not (pu >= 1.0 and pv >= 1.0 and pu < width - 2.0 and pv < height - 2.0):
                return math.nan
            j, i = int(pu), int(pv)
            _cubic_weights(pu - j, wu)
            _cubic_weights(pv - i, wv)
            level = 0.0
            for b in range(4):
                line = 0.0
                for a in range(4):
                    line += wu[a] * image[i - 1 + b, j - 1 + a]
                level += wv[b] * line
            k = v * _SIDE + u
            warped[k] = level
            weighted += W[k] * level
    return weighted


@inline_kernel
def _increment(H, S, T, W, warped, gain, rhs, delta):
    """Write the increment of the template's shape and place; return the weighted sum of squared differences."""
    rhs[:] = 0.0
    residual = 0.0
    for k in range(_COUNT):
        e = gain * warped[k] - T[k]
        residual += W[k] * e * e
        for a in range(8):
            rhs[a] += W[k] * S[k, a] * e
    for a in range(6):
        delta[a] = 0.0
        for b in range(8):
            delta[a] += H[a, b] * rhs[b]
    return residual


@inline_kernel
def _undo(A, c, delta):
    """Undo the increment of the template in the image; return the map and its squared step, NaN if it collapses."""
    D0, D1, D2, D3 = 1.0 + delta[0], delta[1], delta[2], 1.0 + delta[3]
    determinant = D0 * D3 - D1 * D2
    if not determinant > 0.2:
        return A, c, math.nan
    B0, B1 = (A[0] * D3 - A[1] * D2) / determinant, (A[1] * D0 - A[0] * D1) / determinant
    B2, B3 = (A[2] * D3 - A[3] * D2) / determinant, (A[3] * D0 - A[2] * D1) / determinant
    su, sv = B0 * delta[4] + B1 * delta[5], B2 * delta[4] + B3 * delta[5]
    return (B0, B1, B2, B3), (c[0] - su, c[1] - sv), su * su + sv * sv


@inline_kernel
def _align(image, A, c, fu, fv, total, squares, rules, S, T, W, H, warped, rhs, delta, wu, wv):
    """Move the map (A, c) until the template fits; return it, the squares left and the correlation, NaN if lost."""
    max_iterations, smallest_step = rules
    residual, likeness = 0.0, math.nan
    for iteration in range(int(max_iterations) + 1):
        mean = _warp(image, A, c, fu, fv, W, wu, wv, warped) / total
        if not mean < math.inf:
            return A, c, residual, math.nan
        common, energy = 0.0, 0.0
        for k in range(_COUNT):
            warped[k] -= mean
            energy += W[k] * warped[k] * warped[k]
            common += W[k] * warped[k] * T[k]
        if not energy > 1e-3 * squares or not common > 0.0:
            return A, c, residual, math.nan
        likeness = common / math.sqrt(energy * squares)
        residual = _increment(H, S, T, W, warped, common / energy, rhs, delta)
        if iteration == max_iterations:
            break
        A, c, step = _undo(A, c, delta)
        if not step >= smallest_step**2:
            if not step >= 0.0:
                return A, c, residual, math.nan
            break
    return A, c, residual, likeness


@inline_kernel
def _place_covariance(H, A, variance, covariance):
    """Carry the covariance of the place in the template to the image."""
    c00, c01, c11 = H[4, 4], H[4, 5], H[5, 5]
    left0, left1 = A[0] * c00 + A[1] * c01, A[0] * c01 + A[1] * c11
    right0, right1 = A[2] * c00 + A[3] * c01, A[2] * c01 + A[3] * c11
    covariance[0, 0] = variance * (left0 * A[0] + left1 * A[1])
    covariance[0, 1] = variance * (left0 * A[2] + left1 * A[3])
    covariance[1, 0] = covariance[0, 1]
    covariance[1, 1] = variance * (right0 * A[2] + right1 * A[3])


@loop
def _align_all(
    image, templates, fractions, template_index, pixels, shapes, gates, out_pixels, covariance, correlation
):  # fmt: skip
    """Align one template per row to the image; correlation NaN where it left the image or has no texture."""
    spread, max_iterations, smallest_step, shape_sigma, unexplained, min_texture = gates
    window = np.empty(_SIDE)
    for k in range(_SIDE):
        window[k] = math.exp(-0.5 * ((k - RADIUS) / spread) ** 2)
    S, T, W, warped = np.empty((_COUNT, 8)), np.empty(_COUNT), np.empty(_COUNT), np.empty(_COUNT)
    H, rhs, delta, wu, wv = np.empty((8, 8)), np.empty(8), np.empty(8), np.empty(4), np.empty(4)
    for row in range(pixels.shape[0]):
        correlation[row] = math.nan
        out_pixels[row, 0], out_pixels[row, 1] = pixels[row, 0], pixels[row, 1]
        number = template_index[row]
        fu, fv = fractions[number, 0], fractions[number, 1]
        if not abs(fu) + abs(fv) < math.inf:
            continue
        total, squares = _describe(templates, number, fu, fv, window, S, T, W, H)
        if not squares > min_texture * total:
            continue
        if not _invert_normal(H, unexplained * squares / total, shape_sigma):
            continue
        A = shapes[row, 0, 0], shapes[row, 0, 1], shapes[row, 1, 0], shapes[row, 1, 1]
        c = pixels[row, 0] - 0.5, pixels[row, 1] - 0.5
        rules = (max_iterations, smallest_step)
        A, c, residual, likeness = _align(
            image, A, c, fu, fv, total, squares, rules, S, T, W, H, warped, rhs, delta, wu, wv
        )
        if not abs(likeness) < math.inf:
            continue
        correlation[row] = likeness
        out_pixels[row, 0], out_pixels[row, 1] = c[0] + 0.5, c[1] + 0.5
        _place_covariance(H, A, residual / total * _COUNT / (_COUNT - 8.0), covariance[row])


# --------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True)
class Templates:
    """Patches cut about keypoints."""

    #: (P, 17, 17) float32, smoothed grey levels.
    levels: npt.NDArray[np.float32]
    #: (P, 2) the keypoint relative to the centre of the middle pixel, pixels; NaN where the image ends too near.
    fractions: FloatArray


@dataclass(frozen=True)
class Alignment:
    """Where templates were found."""

    #: (N, 2) place of the keypoint in the image, pixels; the given one where nothing was found.
    pixels: FloatArray
    #: (N, 2, 2) covariance of that place, pixels squared; zero where nothing was found.
    covariance: FloatArray
    #: (N,) correlation coefficient of the template and the image under it, -1 to 1; NaN where nothing was found.
    correlation: FloatArray

    @property
    def found(self) -> BoolArray:
        """(N,) whether the iteration ended inside the image, on texture."""
        return np.isfinite(self.correlation)


def cut_templates(smooth_image: npt.NDArray[np.float32], pixels: FloatArray) -> Templates:
    """Cut a template about each keypoint (N, 2) of an image made by :func:`smoothed`.

    The template is copied, not interpolated; the keypoint lies between its pixels.
    """
    pixels = as_rows(pixels, (2,), "pixels")
    templates = np.zeros((len(pixels), SIZE, SIZE), np.float32)
    fractions = np.zeros((len(pixels), 2))
    _cut_all(smooth_image, pixels, templates, fractions)
    return Templates(templates, fractions)


def align_templates(
    smooth_image: npt.NDArray[np.float32],
    templates: Templates,
    template_index: IntArray,
    pixels: FloatArray,
    shapes: FloatArray,
) -> Alignment:
    """Align templates to an image.

    Parameters
    ----------
    smooth_image : (H, W) float32
        Made by :func:`smoothed`.
    templates : Templates
        From other images.
    template_index : (N,) int
        The template of each row.
    pixels : (N, 2) float64
        Initial places, exact to a pixel or two, pixels.
    shapes : (N, 2, 2) float64
        Derivative of pixels in this image by pixels of the template, to about a fifth.

    Returns
    -------
    Alignment
        Places, covariances and correlations.

    Raises
    ------
    ShapeError
        If an array has another shape.
    """
    pixels, shapes = as_rows(pixels, (2,), "pixels"), as_rows(shapes, (2, 2), "shapes")
    index = np.ascontiguousarray(template_index, dtype=np.int64)
    if not len(index) == len(pixels) == len(shapes):
        raise ShapeError(
            f"template_index, pixels and shapes must be equally long; got {len(index)}, {len(pixels)}, {len(shapes)}."
        )
    found = np.zeros((len(pixels), 2))
    covariance, correlation = np.zeros((len(pixels), 2, 2)), np.zeros(len(pixels))
    _align_all(
        smooth_image, templates.levels, templates.fractions, index, pixels, shapes, numbers(PATCHES), found, covariance,
        correlation,
    )  # fmt: skip
    return Alignment(found, covariance, correlation)
