# SPDX-License-Identifier: BSD-3-Clause
r"""How a camera turned between two frames, from small images: where constant velocity predicts badly.

A turn moves the whole image by the homography :math:`K R K^{-1}`, whatever the depth. Small images forgive blur
and wide steps. Correlation gives a shift, and Gauss-Newton on :math:`R` brings the images to agree. What is found
counts only if the surroundings of the followed points then agree better than where they were predicted.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

from groma._numba import kernel, loop, unrolled_loop
from groma._ordering import copy
from groma._typing import FloatArray
from groma.estimators.batch_least_squares import solve_damped
from groma.features.images import IMAGES
from groma.geometry import quaternion, se3, so3
from groma.geometry.so3 import exp_kernel
from groma.tracking.frame.camera import TrackCamera, into, rotation
from groma.tracking.gates import DEFAULT, TurnGates

SmallImage = npt.NDArray[np.float32]
_THREE = (None,) * 3  # derived from the numbers of a turn


# ------------------------------------------------------------------------------------------------------------ Kernels


@kernel
def _grey(image, x, y):
    """Grey level at a place inside an image, between four pixels."""
    i, j = min(int(y), image.shape[0] - 2), min(int(x), image.shape[1] - 2)
    fx, fy = x - j, y - i
    top = image[i, j] * (1.0 - fx) + image[i, j + 1] * fx
    bottom = image[i + 1, j] * (1.0 - fx) + image[i + 1, j + 1] * fx
    return top * (1.0 - fy) + bottom * fy


@loop
def _turn_image(before, K, turn, moved, seen):
    """Write an image as a camera sees it after a turn, and which pixels and neighbours it shows."""
    height, width = before.shape
    for i in range(height):
        for j in range(width):
            x, y = (j - K[0, 2]) / K[0, 0], (i - K[1, 2]) / K[1, 1]
            z = turn[0, 2] * x + turn[1, 2] * y + turn[2, 2]
            u = K[0, 0] * (turn[0, 0] * x + turn[1, 0] * y + turn[2, 0]) / z + K[0, 2]
            v = K[1, 1] * (turn[0, 1] * x + turn[1, 1] * y + turn[2, 1]) / z + K[1, 2]
            shown = z > 0.0 and 0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0
            moved[i, j] = _grey(before, u, v) if shown else np.nan
    for i in range(1, height - 1):
        for j in range(1, width - 1):
            seen[i, j] = not math.isnan(moved[i - 1 : i + 2, j - 1 : j + 2].sum())


@loop
def _compare(before, now, K, turn, outlier, H, gradient):
    """Write the normal equations of a small left turn; return the share of the image that is seen, and correlation."""
    height, width = now.shape
    moved, seen = np.empty((height, width)), np.zeros((height, width), np.bool_)
    _turn_image(before, K, turn, moved, seen)
    count, a, b, aa, bb, ab = 0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(height):
        for j in range(width):
            if seen[i, j]:
                one, two = moved[i, j], float(now[i, j])
                count, a, b = count + 1, a + one, b + two
                aa, bb, ab = aa + one * one, bb + two * two, ab + one * two
    H[:], gradient[:] = 0.0, 0.0
    if count == 0:
        return 0.0, -1.0
    a, b = a / count, b / count
    score = (ab - count * a * b) / max(math.sqrt((aa - count * a * a) * (bb - count * b * b)), 1e-9)
    # The median difference, to an eighth of a grey level.
    of_size = np.zeros(4096, np.int64)
    for i in range(height):
        for j in range(width):
            if seen[i, j]:
                of_size[min(int(8.0 * abs(moved[i, j] - a - now[i, j] + b)), 4095)] += 1
    median, below = 0, of_size[0]
    while 2 * below < count:
        median += 1
        below += of_size[median]
    limit = max(outlier * 0.125 * median, 1.0)
    J = np.empty(3)
    for i in range(height):
        for j in range(width):
            if not seen[i, j]:
                continue
            # Pixels by a small left turn of the camera: d(x, y) = (-x y, 1 + x^2, -y; -1 - y^2, x y, x) d omega.
            # Content moves forward, so the value at a pixel changes by the gradient against the motion.
            up, down = moved[i - 1], moved[i + 1]
            middle = 2.0 * (moved[i, j + 1] - moved[i, j - 1])
            along_u = -0.125 * K[0, 0] * (up[j + 1] - up[j - 1] + middle + down[j + 1] - down[j - 1])
            middle = 2.0 * (down[j] - up[j])
            along_v = -0.125 * K[1, 1] * (down[j - 1] - up[j - 1] + middle + down[j + 1] - up[j + 1])
            x, y = (j - K[0, 2]) / K[0, 0], (i - K[1, 2]) / K[1, 1]
            J[0] = -along_u * x * y - along_v * (1.0 + y * y)
            J[1] = along_u * (1.0 + x * x) + along_v * x * y
            J[2] = -along_u * y + along_v * x
            error = moved[i, j] - a - now[i, j] + b
            weight = 1.0 / (1.0 + (error / limit) ** 2)
            for k in range(3):
                gradient[k] += weight * J[k] * error
                for m in range(3):
                    H[k, m] += weight * J[k] * J[m]
    return count / (height * width), score


@unrolled_loop
def _turn_until_best(before, now, K, limits, steps, best):
    """Improve a rotation by Gauss-Newton; return the correlation of the images at the best one."""
    outlier, min_overlap, converged = limits
    turn, after, by = best.copy(), np.empty((3, 3)), np.empty(9)
    H, gradient, L, omega = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    best_score = -np.inf
    for _ in range(steps):
        share, score = _compare(before, now, K, turn, outlier, H, gradient)
        if share < min_overlap:
            break
        if score > best_score:
            best_score = score
            for i in range(3):
                copy(turn[i], best[i])
        little = 1e-6 * (H[0, 0] + H[1, 1] + H[2, 2] + 1.0)
        for k in range(3):
            H[k, k] += little
        if not solve_damped(H, -gradient, 0.0, L, omega, _THREE):
            break
        exp_kernel(omega[0], omega[1], omega[2], by)
        for i in range(3):
            for j in range(3):
                after[i, j] = by[3 * i] * turn[0, j] + by[3 * i + 1] * turn[1, j] + by[3 * i + 2] * turn[2, j]
        for i in range(3):
            copy(after[i], turn[i])
        if max(abs(omega[0]), abs(omega[1]), abs(omega[2])) * K[0, 0] < converged:
            break
    return best_score


@kernel
def _surroundings(image, x, y, patch):
    """Write the 5 x 5 surroundings of a place in an image with a margin; return their mean."""
    i, j = int(y), int(x)
    fx, fy, mean = x - j, y - i, 0.0
    for row in range(5):
        top, bottom = image[i + row], image[i + row + 1]
        for n in range(5):
            one, two = (
                top[j + n] * (1.0 - fx) + top[j + n + 1] * fx,
                bottom[j + n] * (1.0 - fx) + bottom[j + n + 1] * fx,
            )
            patch[5 * row + n] = one * (1.0 - fy) + two * fy
            mean += patch[5 * row + n] / 25.0
    return mean


@loop
def _correlate(before, now, first, second, noise, each):
    """Write the correlation of the surroundings of places in both images; return that of all together.

    Places are of the first pixel of their surroundings.
    """
    one, two = np.empty(25), np.empty(25)
    all_aa, all_bb, all_ab = noise, noise, 0.0
    for k in range(first.shape[0]):
        mean_a = _surroundings(before, first[k, 0], first[k, 1], one)
        mean_b = _surroundings(now, second[k, 0], second[k, 1], two)
        aa, bb, ab = 0.0, 0.0, 0.0
        for n in range(25):
            a, b = one[n] - mean_a, two[n] - mean_b
            aa, bb, ab = aa + a * a, bb + b * b, ab + a * b
        each[k] = ab / math.sqrt((aa + noise) * (bb + noise))
        all_aa, all_bb, all_ab = all_aa + aa, all_bb + bb, all_ab + ab
    return all_ab / math.sqrt(all_aa * all_bb)


# ------------------------------------------------------------------------------------------------------------- Public


def small_image(gray: npt.NDArray[np.uint8], gates: TurnGates = DEFAULT.turns) -> SmallImage:
    """Return a small, blurred image."""
    height, width = gray.shape
    size = (gates.width, max(round(gates.width * height / width), 8))
    reduced = cv2.resize(gray, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(reduced, (0, 0), IMAGES.blur), np.float32)


def turn_between(
    camera: TrackCamera, before: SmallImage, now: SmallImage, starts: list[FloatArray], gates: TurnGates = DEFAULT.turns
) -> FloatArray:
    """Return the rotation (3, 3) now_from_before that brings two small images to agree best.

    Parameters
    ----------
    camera
        The camera of the full images.
    before, now
        From :func:`small_image`.
    starts
        Initial rotations, besides the shift found by correlation.
    gates
        Numbers of the alignment.
    """
    first, second = (np.asarray(cv2.pyrDown(image), np.float32) for image in (before, now))
    K = _matrix(camera, before.shape)
    dx, dy = _shift(before, now)
    shifted = so3.exp(np.array([[-dy / K[1, 1], dx / K[0, 0], 0.0]]))[0]
    coarse = _matrix(camera, first.shape)
    agree = [_align(coarse, first, second, start, gates, 1)[1] for start in [*starts, shifted]]
    best = _align(coarse, first, second, [*starts, shifted][int(np.argmax(agree))], gates, gates.steps)[0]
    return _align(K, before, now, best, gates, gates.steps)[0]


def _matrix(camera: TrackCamera, shape: tuple[int, ...]) -> FloatArray:
    """Calibration matrix (3, 3) of a reduced image, in OpenCV's pixels."""
    scale = np.array([shape[1] / camera.width, shape[0] / camera.height])
    K = camera.matrix_opencv
    K[:2] *= scale[:, None]
    K[:2, 2] += 0.5 * (scale - 1.0)
    return K


def _shift(before: SmallImage, now: SmallImage) -> FloatArray:
    """Shift (2,) of the middle of the first image in the second, pixels, by correlation."""
    height, width = before.shape
    top, left = height // 4, width // 4
    score = cv2.matchTemplate(now, before[top : height - top, left : width - left], cv2.TM_CCOEFF_NORMED)
    row, column = np.unravel_index(int(np.argmax(score)), score.shape)
    return np.array([column - left, row - top], dtype=float)


def _align(
    K: FloatArray, before: SmallImage, now: SmallImage, start: FloatArray, gates: TurnGates, steps: int
) -> tuple[FloatArray, float]:
    """Gauss-Newton on the rotation; return the best one with the correlation of the images where they overlap.

    One step gives their initial agreement.
    """
    best = np.array(start, dtype=np.float64)
    limits = float(gates.outlier), float(gates.min_overlap), float(gates.converged)
    return best, _turn_until_best(before, now, K, limits, steps, best)


def surroundings_agree(
    before: SmallImage, now: SmallImage, shape: tuple[int, int], pixels: FloatArray, guesses: FloatArray
) -> tuple[float, float]:
    """Correlation of the surroundings of places in the first image with those of guesses in the second.

    Returns the median over the places, and the correlation of all surroundings together, in which edges weigh most.
    Places that leave the image do not count; -1 if fewer than a quarter remain.
    """
    height, width = before.shape
    with np.errstate(invalid="ignore"):
        inside = ((guesses >= 0) & (guesses <= (shape[1], shape[0]))).all(axis=1)
    if 4 * inside.sum() < len(pixels):
        return -1.0, -1.0
    scale = np.array([width / shape[1], height / shape[0]])
    each, noise = np.zeros(int(inside.sum())), IMAGES.noise**2
    # Beyond the image its border goes on.
    wide = [cv2.copyMakeBorder(image, 4, 4, 4, 4, cv2.BORDER_REPLICATE) for image in (before, now)]
    begins = (places[inside] * scale + 1.5 for places in (pixels, guesses))  # 4 - 2 - 0.5
    together = _correlate(*wide, *begins, noise, each)
    return float(np.median(each)), float(together)


def turned(
    camera: TrackCamera,
    before: npt.NDArray[np.uint8],
    now: npt.NDArray[np.uint8],
    pose: FloatArray,
    gates: TurnGates = DEFAULT.turns,
) -> FloatArray:
    """Return the pose (7,) of a frame whose predecessor had one, from the turn between their images alone."""
    return _after(turn_between(camera, small_image(before, gates), small_image(now, gates), [np.eye(3)], gates), pose)


def _after(turn: FloatArray, pose: FloatArray) -> FloatArray:
    """Turn a camera where it is: pose (7,) after a rotation (3, 3) now_from_before."""
    by_turn = np.concatenate([quaternion.from_matrix(turn), np.zeros(3)])
    return se3.compose(by_turn[None], pose[None])[0]


def turned_prediction(
    camera: TrackCamera,
    before: SmallImage,
    now: SmallImage,
    followed: tuple[FloatArray, FloatArray],
    spread: Callable[[], tuple[FloatArray, FloatArray]],
    previous: FloatArray,
    predicted: FloatArray,
    gates: TurnGates = DEFAULT.turns,
) -> FloatArray | None:
    """Return a pose (7,) that explains a frame better than a prediction, or None where the prediction is good.

    Parameters
    ----------
    camera
        The camera.
    before, now
        From :func:`small_image`: the frame before, whose pose is known, and the present one.
    followed : (n, 2), (n, 3)
        Pixels of followed points in the frame before, and where they are in the world: these ask for a turn.
    spread : callable
        Returns the same, (m, 2) and (m, 3), spread over the image where depth is known there: these judge it, with the
        others. Asked where the prediction is not good.
    previous, predicted : (7,)
        Pose of the frame before, and the prediction for this one.
    gates
        What counts as agreement.
    """
    shape = camera.height, camera.width

    def agree(pose: FloatArray, pixels: FloatArray, places: FloatArray) -> tuple[float, float]:
        moved = pixels + camera.project(into(pose, places)) - camera.project(into(previous, places))
        return surroundings_agree(before, now, shape, pixels, np.where(np.isfinite(moved), moved, -1e6))

    if len(followed[0]) >= gates.min_places and agree(predicted, *followed)[0] > gates.agrees:
        return None
    every = tuple(np.concatenate(both) for both in zip(followed, spread(), strict=True))
    if len(every[0]) < gates.min_places:
        return None
    expected = agree(predicted, *every)[1]
    turns = [rotation(predicted) @ rotation(previous).T, np.eye(3)]
    # The same turn, with the way that was predicted or without any.
    center = se3.inverse(predicted[None])[0, 4:]
    stayed = _after(turn_between(camera, before, now, turns, gates), previous)
    went = stayed.copy()
    went[4:] = -rotation(stayed) @ center
    scores = [agree(pose, *every)[1] for pose in (stayed, went)]
    k = int(np.argmax(scores))
    return (stayed, went)[k] if scores[k] > expected + gates.gain else None
