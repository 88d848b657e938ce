# SPDX-License-Identifier: BSD-3-Clause
r"""How probable it is that a line is right, from what its observations say.

A line is called right where an edge of the object runs along it. Its probability is a logistic model

.. math:: p = \frac{1}{1 + \exp(-w_0 - \sum_k w_k x_k)}

of six quantities that a scene has of every line (:func:`line_evidence`); none depends on the unit of length. The
weights were fitted on rendered scenes whose edges are known exactly, and the probabilities compared with those of other
scenes (``benchmarks/line_confidence.py``, and its page of the documentation).
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from groma._typing import BoolArray, FloatArray
from groma.cameras import model as camera_model
from groma.geometry import quaternion, segment2
from groma.geometry.algebra import norm
from groma.mapping.groups import num_distinct
from groma.mapping.noise.landmarks import LineNoise, line_noise
from groma.scene import Scene

#: The quantities, and the weight of each as ``benchmarks/line_confidence.py`` found it.
WEIGHTS: dict[str, float] = {
    "constant": -21.845,
    "images": 0.170,
    "spread": -0.476,
    "uncertainty": -1.160,
    "misfit": -2.026,
    "support": 0.331,
    "length": 3.316,
}
#: Lines of a smaller probability are no part of a map: all are, unless it is asked for fewer. The probability was
#: fitted on rendered photographs of few sizes; on others, fisheyes above all, it is too strict to decide unasked.
DEFAULT_CONFIDENCE = 0.0
#: An image that would show less of a line than this, pixels, is not expected to show it: the default of detection.
_MIN_LENGTH = 12.0
#: Smallest misfit and spread, below which they say nothing more.
_MIN_MISFIT, _MIN_SPREAD = 0.1, 1e-4


def with_confidence(scene: Scene) -> Scene:
    """Return the scene with the probability of each line to be right."""
    return scene.replace(lines=scene.lines.replace(confidence=line_confidence(scene)))


def left_out(kept: BoolArray, min_confidence: float) -> str:
    """Say how many lines did not reach a probability; empty where all did."""
    count = int((~kept).sum())
    if not count:
        return ""
    are = "line was" if count == 1 else "lines were"
    return f" {count:,} {are} left out: right with a probability below {min_confidence:g} (--min-confidence)."


def line_confidence(scene: Scene) -> FloatArray:
    """Return the probability (L,) that each line is right."""
    return expit(line_evidence(scene) @ np.array(list(WEIGHTS.values())))


def line_evidence(scene: Scene) -> FloatArray:
    r"""Return what the probability of each line is computed from, (L, 7), in the order of ``WEIGHTS``.

    ===============  ================================================================================================
    ``constant``     1
    ``images``       logarithm of the number of images that show it
    ``spread``       logarithm of :math:`\sqrt{\lambda}`, the smaller eigenvalue of the mean of :math:`n n^\top` over
                     the normals of its viewing planes: how far apart the views are, as the sine of an angle
    ``uncertainty``  logarithm of the largest standard deviation of its ends across it, over the usual distance of
                     lines from their cameras
    ``misfit``       logarithm of its reduced chi: residuals over their expected size
    ``support``      log odds of an image showing it, among the images in whose frame it lies
    ``length``       logarithm of its longest observed segment, pixels
    ===============  ================================================================================================
    """
    seen, noise = scene.line_observations, line_noise(scene)
    images = num_distinct(seen.line_idx, seen.image_idx, scene.num_lines)
    longest = np.zeros(scene.num_lines)
    np.maximum.at(longest, seen.line_idx, segment2.length(seen.segment))
    expected = np.maximum(_num_in_frame(scene), images)
    return np.column_stack(
        [
            np.ones(scene.num_lines),
            np.log(np.maximum(images, 1)),
            np.log(_spread(scene, noise)),
            np.log(_deviation(noise) / _usual_distance(scene)),
            np.log(np.maximum(noise.misfit, _MIN_MISFIT)),
            np.log((images + 0.5) / (expected - images + 0.5)),
            np.log(np.maximum(longest, 1.0)),
        ]
    )


def _deviation(noise: LineNoise) -> FloatArray:
    """(L,) largest standard deviation of an end across its line."""
    blocks = noise.covariance.reshape(-1, 2, 2, 2, 2)
    ends = np.stack([blocks[:, 0, :, 0], blocks[:, 1, :, 1]], axis=1)
    return np.sqrt(np.maximum(np.linalg.eigvalsh(ends)[..., 1].max(axis=1), 1e-300))


def _usual_distance(scene: Scene) -> float:
    """Median over lines of the mean distance from the cameras that see them."""
    seen = scene.line_observations
    if len(seen) == 0:
        return 1.0
    away = norm(scene.lines.segments[seen.line_idx].mean(axis=1) - scene.cam_centers_in_world[seen.image_idx])
    count = np.bincount(seen.line_idx, minlength=scene.num_lines)
    mean = np.bincount(seen.line_idx, away, scene.num_lines) / np.maximum(count, 1)
    return max(float(np.median(mean[count > 0])), 1e-300)


def _spread(scene: Scene, noise: LineNoise) -> FloatArray:
    """(L,) how far apart the views of each line are."""
    seen, direction = scene.line_observations, scene.lines.plucker[:, 3:]
    away = scene.lines.segments[seen.line_idx, 0] - scene.cam_centers_in_world[seen.image_idx]
    normal = np.cross(away, direction[seen.line_idx])
    normal /= np.maximum(norm(normal), 1e-300)[:, None]
    flat = np.einsum("nai,ni->na", noise.across[seen.line_idx], normal)
    moments = [
        np.bincount(seen.line_idx, flat[:, a] * flat[:, b], scene.num_lines) for a, b in ((0, 0), (0, 1), (1, 1))
    ]
    number = np.maximum(np.bincount(seen.line_idx, minlength=scene.num_lines), 1)
    xx, xy, yy = (moment / number for moment in moments)
    smaller = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
    return np.sqrt(np.maximum(smaller, _MIN_SPREAD**2))


def _num_in_frame(scene: Scene) -> FloatArray:
    """(L,) number of images in whose frame a line lies whole and is long enough to be found."""
    found, poses = np.zeros(scene.num_lines), scene.cam_from_world
    for image, camera in enumerate(scene.images.camera_idx):
        size = np.array([scene.cameras.width[camera], scene.cameras.height[camera]], float)
        model = camera_model(scene.cameras.models[camera])
        in_cam = quaternion.rotate(poses[image, :4], scene.lines.segments) + poses[image, 4:]
        places = np.ascontiguousarray(in_cam.reshape(-1, 3))
        pixels = model.project(scene.cameras.params[camera, : model.num_parameters], places).reshape(-1, 4)
        front = np.ones(len(in_cam), bool) if model.sees_behind else (in_cam[..., 2] > 0.0).all(axis=1)
        found += front & _inside(pixels, size) & (segment2.length(np.nan_to_num(pixels)) >= _MIN_LENGTH)
    return found


def _inside(pixels: FloatArray, size: FloatArray) -> BoolArray:
    ends = pixels.reshape(-1, 2, 2)
    inside = ((ends >= 0.0) & (ends <= size)) if size.all() else np.isfinite(ends)
    return np.asarray(inside.all(axis=(1, 2)), np.bool_)


__all__ = ["DEFAULT_CONFIDENCE", "WEIGHTS", "left_out", "line_confidence", "line_evidence", "with_confidence"]
