# SPDX-License-Identifier: BSD-3-Clause
r"""How a camera turned between two frames, from small images: where constant velocity predicts badly.

A turn moves the whole image by the homography :math:`K R K^{-1}`, whatever the depth. Small images forgive blur
and wide steps. Correlation gives a shift, and Gauss-Newton on :math:`R` brings the images to agree. What is found
counts only if the surroundings of the followed points then agree better than where they were predicted.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray
from groma.geometry import quaternion, se3, so3
from groma.tracking.frame.camera import TrackCamera, into, rotation
from groma.tracking.gates import DEFAULT, TurnGates

_SmallImage = npt.NDArray[np.float32]


def small_image(gray: npt.NDArray[np.uint8], gates: TurnGates = DEFAULT.turns) -> _SmallImage:
    """Return a small, blurred image."""
    height, width = gray.shape
    size = (gates.width, max(round(gates.width * height / width), 8))
    reduced = cv2.resize(gray, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(reduced, (0, 0), gates.blur), np.float32)


def turn_between(
    camera: TrackCamera,
    before: _SmallImage,
    now: _SmallImage,
    starts: list[FloatArray],
    gates: TurnGates = DEFAULT.turns,
) -> FloatArray:
    """Return the rotation (3, 3) now_from_before that brings two small images to agree best.

    Parameters
    ----------
    camera
        The camera of the full images.
    before, now
        From :func:`small_image`.
    starts
        Rotations to begin from, beside the shift that correlation finds.
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


def _shift(before: _SmallImage, now: _SmallImage) -> FloatArray:
    """Shift (2,) of the middle of the first image in the second, pixels, by correlation."""
    height, width = before.shape
    top, left = height // 4, width // 4
    score = cv2.matchTemplate(now, before[top : height - top, left : width - left], cv2.TM_CCOEFF_NORMED)
    row, column = np.unravel_index(int(np.argmax(score)), score.shape)
    return np.array([column - left, row - top], dtype=float)


def _align(
    K: FloatArray, before: _SmallImage, now: _SmallImage, start: FloatArray, gates: TurnGates, steps: int
) -> tuple[FloatArray, float]:
    """Gauss-Newton on the rotation; return the best one with the correlation of the images where they overlap.

    One step tells how well they agree at the start.
    """
    height, width = now.shape
    inverse = np.linalg.inv(K)
    v, u = np.mgrid[0:height, 0:width].reshape(2, -1)
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    # Pixels by a small left turn of the camera: d(x, y) = (-x y, 1 + x^2, -y; -1 - y^2, x y, x) d omega.
    along_u = K[0, 0] * np.stack([-x * y, 1.0 + x * x, -y], axis=1)
    along_v = K[1, 1] * np.stack([-1.0 - y * y, x * y, x], axis=1)
    inside = np.ones(before.shape, np.uint8)
    turn, best, best_score = start, start, -np.inf
    for _ in range(steps):
        homography = K @ turn @ inverse
        moved = cv2.warpPerspective(before, homography, (width, height), flags=cv2.INTER_LINEAR)
        both = cv2.warpPerspective(inside, homography, (width, height), flags=cv2.INTER_NEAREST)
        seen = np.asarray(cv2.erode(both, np.ones((3, 3), np.uint8))).ravel() > 0
        if seen.sum() < gates.min_overlap * seen.size:
            break
        a, b = np.asarray(moved, np.float64).ravel()[seen], now.ravel()[seen].astype(np.float64)
        a, b = a - a.mean(), b - b.mean()
        score = float((a @ b) / max(np.sqrt((a @ a) * (b @ b)), 1e-9))
        if score > best_score:
            best, best_score = turn, score
        # Content moves forward, so the value at a pixel changes by the gradient against the motion.
        gradient = [0.125 * np.asarray(cv2.Sobel(moved, cv2.CV_32F, *of)).ravel()[seen] for of in ((1, 0), (0, 1))]
        J = -(gradient[0][:, None] * along_u[seen] + gradient[1][:, None] * along_v[seen])
        size = np.abs(a - b)
        weight = 1.0 / (1.0 + (size / max(gates.outlier * float(np.median(size)), 1.0)) ** 2)
        weighted = weight[:, None] * J
        H = weighted.T @ J
        omega = -np.linalg.solve(H + 1e-6 * (np.trace(H) + 1.0) * np.eye(3), weighted.T @ (a - b))
        turn = so3.exp(omega[None])[0] @ turn
        if np.abs(omega).max() * K[0, 0] < gates.converged:
            break
    return best, best_score


def surroundings_agree(
    before: _SmallImage,
    now: _SmallImage,
    shape: tuple[int, int],
    pixels: FloatArray,
    guesses: FloatArray,
    noise: float = DEFAULT.turns.noise,
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
    offset = np.stack(np.meshgrid([-2, -1, 0, 1, 2], [-2, -1, 0, 1, 2]), axis=-1).reshape(1, -1, 2).astype(np.float32)
    scale = np.array([width / shape[1], height / shape[0]])
    patches = []
    for image, places in ((before, pixels[inside]), (now, guesses[inside])):
        at = (places * scale - 0.5)[:, None].astype(np.float32) + offset
        values = cv2.remap(
            image, np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1]), cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        patches.append(np.asarray(values, np.float64))
    a, b = (patch - patch.mean(axis=1, keepdims=True) for patch in patches)
    aa, bb, ab = (a * a).sum(axis=1), (b * b).sum(axis=1), (a * b).sum(axis=1)
    each = ab / np.sqrt((aa + noise) * (bb + noise))
    return float(np.median(each)), float(ab.sum() / np.sqrt((aa.sum() + noise) * (bb.sum() + noise)))


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
    before: npt.NDArray[np.uint8],
    now: npt.NDArray[np.uint8],
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
    before, now : (H, W) uint8
        The frame before, whose pose is known, and the present one.
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
    small = small_image(before, gates), small_image(now, gates)

    def agree(pose: FloatArray, pixels: FloatArray, places: FloatArray) -> tuple[float, float]:
        moved = pixels + camera.project(into(pose, places)) - camera.project(into(previous, places))
        return surroundings_agree(*small, now.shape, pixels, np.where(np.isfinite(moved), moved, -1e6), gates.noise)

    if len(followed[0]) >= gates.min_places and agree(predicted, *followed)[0] > gates.agrees:
        return None
    every = tuple(np.concatenate(both) for both in zip(followed, spread(), strict=True))
    if len(every[0]) < gates.min_places:
        return None
    expected = agree(predicted, *every)[1]
    turns = [rotation(predicted) @ rotation(previous).T, np.eye(3)]
    # The same turn, with the way that was predicted or without any.
    center = se3.inverse(predicted[None])[0, 4:]
    stayed = _after(turn_between(camera, *small, turns, gates), previous)
    went = stayed.copy()
    went[4:] = -rotation(stayed) @ center
    scores = [agree(pose, *every)[1] for pose in (stayed, went)]
    k = int(np.argmax(scores))
    return (stayed, went)[k] if scores[k] > expected + gates.gain else None
