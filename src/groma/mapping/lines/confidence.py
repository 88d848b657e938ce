# SPDX-License-Identifier: BSD-3-Clause
r"""How probable it is that a line is right, from what its observations say.

A line is called right where an edge of the object runs along it, at least along half of it, within 2.5 thousandths of
the usual distance of lines from their cameras. Four things must be true of it:

.. math:: p = \frac{1}{1 + \exp(-w_0 - \sum_k w_k x_k - b)}\;
          E\Bigl[\frac{1}{1 + \exp(-z(x_t, x_l, \mu) - c)}\Bigr]\;
          \bigl(2 F_4(\tau / u) - 1\bigr)\; \operatorname{erf}\frac{1}{\sqrt 2\, r}.

The first factor, that its segments belong together, is a logistic model of five quantities (:func:`line_evidence`). The
outline of a round body is no edge, and moves with the view: its segments drift from any line that stands still, and
images that show the body beside it do not show it where others do. How many lines of a scene have an edge is not known
beforehand: nearly all of a plain box, few of an upholstered chair. Their share, of log odds b, is estimated from the
lines themselves, with a prior of m lines of which half have one (:func:`edge_probability`). The second, that they are
no texture, is told by contrast (:mod:`groma.features.contrast`), since texture has stripes of the same gradient beside
it. Where views agree on texture, as they do on stripes of a wall, only this factor tells: stripes are found at the same
place by any photographs. The logarithm of the contrast :math:`x_t` of stripes is normal with a mean and a deviation
that texture has anywhere, as it is divided by its own surroundings; z is the logarithm of the likelihood ratio of edges
to stripes, by contrast and by length. How far edges stand out is a matter of the scene: much on plain walls, little
between rough stones. So the mean :math:`\mu` of edges is one of the scene, with a wide prior, and E the mean over what
its lines say of it. The length :math:`x_l` is relative to the others of the scene: stripes are short, and of a flight
of steps it tells the edges, between which little contrast is left. The share of lines that are none, of log odds c, is
estimated like the other. The third is the probability of an error within :math:`\tau = 0.0025`, where u is the standard
deviation across the line that half of its places do not exceed, over the usual distance, and F the Student distribution
of four degrees of freedom: errors have heavy tails, since what edges beside it displace is displaced in all images
alike. Segments and the planes that the line lies on tell u together: of an edge that all images see from one height,
planes know the depth. The fourth is the share of normal residuals of r pixels root mean square within the width of an
edge, a pixel: chords of curves fit no single line, and where segments of a curve are bowed their standard deviations,
and with them r, say so.

No quantity depends on the unit of length or on how many pixels an image has. The weights were fitted on rendered scenes
of boxes and round bodies whose edges are known exactly, and the probabilities compared with those of other scenes
(``benchmarks/line_confidence.py``, and its page of the documentation).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
import scipy  # its parts are imported when something of them is first used

from groma._trees import kd_tree, nearest
from groma._typing import BoolArray, FloatArray, IntArray
from groma.adjustment.assembly_options import SURFACE_SIGMA_PX
from groma.adjustment.terms.relations import lengths_per_pixel
from groma.cameras import model as camera_model
from groma.execution import begin, map_in_threads
from groma.features.segments import SEGMENTS
from groma.gates import gate
from groma.geometry import quaternion, segment2
from groma.geometry.algebra import norm, ratio
from groma.mapping.groups import grouped, num_distinct
from groma.mapping.lines.options import MIN_LENGTH
from groma.mapping.noise.landmarks import LineNoise, line_end_rows, line_noise
from groma.scene import Scene

#: The quantities of the first factor, and the weight of each as ``benchmarks/line_confidence.py`` found it.
WEIGHTS: dict[str, float] = {
    "constant": 2.960, "spread": 1.172, "support": 1.508, "beside": 1.075, "residual": -0.962, "drift": -1.524,
}  # fmt: skip


@dataclass(frozen=True)
class ConfidenceGates:
    """What a line must be within to be right."""

    tolerance: float = gate(0.0025, "1", "error of a right line over the distance", "convention: two pixels")
    freedom: float = gate(
        4.0, "1", "degrees of Student's distribution of errors of lines", "chosen on the scenes of the fit"
    )
    prior_lines: float = gate(
        30.0, "lines", "that the prior on the share of lines with an edge counts for",
        "chosen on the scenes of the fit, each left out in turn",
    )  # fmt: skip
    stripe_contrast: tuple[float, float] = gate(
        (0.75, 0.7), "1", "mean and deviation of the log contrast of stripes", "derived from stairs 3103"
    )
    edge_contrast: tuple[float, float] = gate(
        (3.0, 0.9),
        "1",
        "mean over scenes of that of edges, and its deviation",
        "derived from rendered scenes and walls",
    )
    edge_deviation: float = gate(0.9, "1", "of the log contrast of edges of a scene", "derived from stairs and a room")
    stripe_length: tuple[float, float] = gate(
        (0.85, 0.62), "1", "median of stripes over that of all lines, and deviation of its log", "derived from stairs"
    )
    edge_length: tuple[float, float] = gate((1.39, 0.86), "1", "the same of edges", "derived from stairs")
    edge_px: float = gate(SEGMENTS.edge, "px", "residual of a segment of a right line", "derived from an edge's width")
    usual_contrast: float = gate(30.0, "1", "of segments whose contrast is unknown", "chosen on the scenes of the fit")


GATES = ConfidenceGates()
#: Lines of a smaller probability are no part of a map: they are more likely wrong than right.
DEFAULT_CONFIDENCE = 0.5
#: Largest logarithm of the odds of an edge, and how often the interval is halved in which they lie (cost: time).
_MOST_ODDS, _HALVINGS = 40.0, 50
#: Means of the contrast of edges that are weighed (cost: time).
_MEANS = 31
#: Smallest misfit and spread, below which they say nothing more.
_MIN_MISFIT, _MIN_SPREAD = 0.3, 1e-4
#: Shares of an information below which it is none: that of a line, and of the radius beside it (convention: rounding).
_SINGULAR, _UNKNOWN = 1e-12, 1e-9
#: Shares of a line at which it is asked how well it is known (cost: time).
_PLACES = np.linspace(0.0, 1.0, 9)


def with_confidence(scene: Scene) -> Scene:
    """Return the scene with the probability of each line to be right."""
    return scene.replace(lines=scene.lines.replace(confidence=line_confidence(scene)))


def line_confidence(scene: Scene, surface_px: float = SURFACE_SIGMA_PX) -> FloatArray:
    """Return the probability (L,) that each line is right; surfaces deviate from planes by ``surface_px``."""
    noise = line_noise(scene)
    accuracy = begin(partial(line_accuracy, scene, noise, surface_px=surface_px))
    right = edge_probability(line_evidence(scene, noise), np.array(list(WEIGHTS.values())))
    return right * accuracy()


def edge_probability(evidence: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the probability (L,) that there is an edge, from what :func:`line_evidence` returns and its weights.

    The lines are all those of a scene. Weights are of log likelihood ratios; the shares of lines whose segments belong
    together, and of those among them that are no texture, are estimated from the lines, as is the contrast of edges.
    """
    expit, gates = scipy.special.expit, GATES
    together, contrast, length = evidence[:, :-2] @ weights, *evidence[:, -2:].T
    belongs = expit(together + _share_odds(together, np.ones(len(together))))
    usual, spread = gates.edge_contrast
    means = np.linspace(gates.stripe_contrast[0], usual + 3.0 * spread, _MEANS)[:, None]
    ratio = _edge_ratio(contrast, gates.stripe_contrast, means, gates.edge_deviation)
    (stripe, sigma), (edge, edge_sigma) = gates.stripe_length, gates.edge_length
    ratio = ratio + _edge_ratio(length, (math.log(stripe), sigma), math.log(edge), edge_sigma)
    odds = _share_odds(ratio, belongs)
    # Log likelihood of the lines over that if all were stripes, and the prior of the mean.
    fit = (belongs * (np.logaddexp(0.0, ratio + odds) - np.logaddexp(0.0, odds))).sum(axis=1, keepdims=True)
    fit -= 0.5 * ((means - usual) / spread) ** 2
    weight = np.exp(fit - fit.max())
    return belongs * (weight / weight.sum() * expit(ratio + odds)).sum(axis=0)


def _edge_ratio(
    told: FloatArray, stripe: tuple[float, float], edge: float | FloatArray, edge_sigma: float
) -> FloatArray:
    """(..., L) log likelihood ratios of edges to stripes, both normal, given what is told of lines (L,).

    ``stripe`` has mean and deviation; ``edge`` is one mean or several (M, 1). Edges vary more: below what has the
    smallest ratio, less says nothing more.
    """
    mean, sigma = stripe
    least = (mean / sigma**2 - edge / edge_sigma**2) / (sigma**-2.0 - edge_sigma**-2.0)
    x = np.maximum(told, least)
    return 0.5 * ((x - mean) / sigma) ** 2 - 0.5 * ((x - edge) / edge_sigma) ** 2 + math.log(sigma / edge_sigma)


def _share_odds(ratio: FloatArray, count: FloatArray) -> FloatArray:
    r"""Log odds b (..., 1) of the share of right lines, given log likelihood ratios z (..., L) of lines that count n.

    .. math:: \left(m + \sum_i n_i\right) \pi = \tfrac m2 + \sum_i \frac{n_i}{1 + \exp(-z_i - b)},
              \qquad b = \log\frac{\pi}{1 - \pi},

    is the fixed point of expectation maximisation, of which there is one.
    """
    low = np.full((*ratio.shape[:-1], 1), -_MOST_ODDS)
    high, expit = -low, scipy.special.expit
    for _ in range(_HALVINGS):
        odds = 0.5 * (low + high)
        expected = 0.5 * GATES.prior_lines + (count * expit(ratio + odds)).sum(axis=-1, keepdims=True)
        more = expected > (count.sum() + GATES.prior_lines) * expit(odds)
        low, high = np.where(more, odds, low), np.where(more, high, odds)
    return low


def line_accuracy(
    scene: Scene, noise: LineNoise | None = None, gates: ConfidenceGates = GATES, surface_px: float = SURFACE_SIGMA_PX
) -> FloatArray:
    """Return the probability (L,) that each line lies along its edge, given that there is one.

    ``noise`` is that of the lines, if it is known; surfaces deviate from planes by ``surface_px`` pixels.
    """
    noise = line_noise(scene) if noise is None else noise
    deviation = _deviation(scene, noise, surface_px) / usual_distance(scene)
    within = 2.0 * scipy.special.stdtr(gates.freedom, gates.tolerance / deviation) - 1.0
    return within * scipy.special.erf(gates.edge_px / (math.sqrt(2.0) * _residual_px(scene, noise)))


def line_evidence(scene: Scene, noise: LineNoise | None = None) -> FloatArray:
    r"""Return what the probability that there is an edge is computed from, (L, 8).

    The columns are the quantities of ``WEIGHTS``, in their order, then contrast and length.

    ``noise`` is that of the lines, if it is known.

    ==============  ===============================================================================================
    ``constant``    1
    ``spread``      logarithm of :math:`\sqrt{\lambda}`, the smaller eigenvalue of the mean of :math:`n n^\top` over the
                    normals of its viewing planes: how far apart the views are, as the sine of an angle
    ``support``     log odds of an image showing it, among the images in whose frame it lies
    ``beside``      the same among the images that show the points nearest to it
    ``residual``    logarithm of the root mean square of its residuals, pixels
    ``drift``       logarithm of 1 + t, where t is how many standard deviations the radius is off zero of the cylinder
                    whose outlines explain its segments best
    ``contrast``    mean over its segments of the logarithm of their contrast
    ``length``      logarithm of the length of its longest segment over the median of those of all lines
    ==============  ===============================================================================================
    """
    seen, noise = scene.line_observations, line_noise(scene) if noise is None else noise
    images = num_distinct(seen.line_idx, seen.image_idx, scene.num_lines)
    absent, absent_beside = _num_absent(scene)
    longest = np.ones(scene.num_lines)
    np.maximum.at(longest, seen.line_idx, segment2.length(seen.segment))
    return np.column_stack(
        [
            np.ones(scene.num_lines),
            np.log(_spread(scene, noise)),
            np.log((images + 0.5) / (absent + 0.5)),
            np.log((images + 0.5) / (absent_beside + 0.5)),
            np.log(_residual_px(scene, noise)),
            np.log1p(np.abs(_drift(scene, noise))),
            _log_contrast(scene),
            np.log(longest / (np.median(longest) if len(longest) else 1.0)),
        ]
    )


def _log_contrast(scene: Scene) -> FloatArray:
    """(L,) mean logarithm of the contrast of the segments of each line; the usual one where none is known."""
    seen = scene.line_observations
    known = seen.contrast > 0.0
    line, logs = seen.line_idx[known], np.log(seen.contrast[known])
    count = np.bincount(line, minlength=scene.num_lines)
    mean = np.bincount(line, logs, scene.num_lines) / np.maximum(count, 1)
    return np.where(count > 0, mean, math.log(GATES.usual_contrast))


def _residual_px(scene: Scene, noise: LineNoise) -> FloatArray:
    """(L,) root mean square residual of each line: its misfit times the noise of its segments, pixels."""
    line, logs = scene.line_observations.line_idx, np.log(scene.line_observations.sigma)
    count = np.maximum(np.bincount(line, minlength=scene.num_lines), 1)
    usual = np.exp(np.bincount(line, logs, scene.num_lines) / count)
    return np.maximum(noise.misfit, _MIN_MISFIT) * usual * noise.sigma_px


def _deviation(scene: Scene, noise: LineNoise, surface_px: float) -> FloatArray:
    """(L,) standard deviation across each line, in its worst direction, that half of its places do not exceed."""
    line, plane = scene.relations.line_on_plane.T
    own = scene.relations.sigma("line_on_plane")
    sigma = np.where(own > 0.0, own, surface_px * lengths_per_pixel(scene, "line")[line])
    normal = np.einsum("nai,ni->na", noise.across[line], scene.planes.hesse[plane, :3]) / sigma[:, None]
    by_planes = np.zeros((scene.num_lines, 2, 2))
    np.add.at(by_planes, line, normal[:, :, None] * normal[:, None, :])
    rows, share = np.repeat(np.arange(scene.num_lines), len(_PLACES)), np.tile(_PLACES, scene.num_lines)
    by_segments = noise.by_misfit().at(share, share, rows)
    both = np.linalg.solve(np.eye(2) + by_segments @ by_planes[rows], by_segments)
    worst = np.linalg.eigvalsh(both)[:, -1].reshape(-1, len(_PLACES))
    return np.sqrt(np.maximum(np.median(worst, axis=1), 1e-300))


def usual_distance(scene: Scene) -> float:
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
    smaller = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy**2)  # derived from the roots of a quadratic
    return np.sqrt(np.maximum(smaller, _MIN_SPREAD**2))


def _drift(scene: Scene, noise: LineNoise) -> FloatArray:
    """(L,) radius of the cylinder whose outlines explain the segments of a line best, in standard deviations."""
    ends, seen = line_end_rows(scene), scene.line_observations
    weight = ends.good / (noise.sigma_px * seen.sigma)[:, None]
    row, share = np.where(ends.good[..., None], ends.row, 0.0), np.where(ends.good, ends.share, 0.0)[..., None]
    away = np.where(ends.good, ends.residual, 0.0)
    # Columns: both ends of the line, the radius, which moves the outline to the same side in all views, the residual.
    columns = np.concatenate([(1.0 - share) * row, share * row, norm(row)[..., None], away[..., None]], axis=2)
    columns *= weight[..., None]
    sums = np.zeros((scene.num_lines, 6, 6))
    np.add.at(sums, seen.line_idx, np.einsum("nei,nej->nij", columns, columns))
    line, both = sums[:, :4, :4], sums[:, :4, 4:]
    line = line + _SINGULAR * np.trace(line, axis1=1, axis2=2)[:, None, None] * np.eye(4) + 1e-300 * np.eye(4)
    left = sums[:, 4:, 4:] - np.swapaxes(both, 1, 2) @ np.linalg.solve(line, both)
    information, known = left[:, 0, 0], left[:, 0, 0] > _UNKNOWN * sums[:, 4, 4]
    return ratio(left[:, 0, 1], np.sqrt(np.maximum(information, 0.0)), known, 0.0)


def _num_absent(scene: Scene) -> tuple[FloatArray, FloatArray]:
    """(L,) numbers of images that do not show a line: those in whose frame it lies, and those that show what is beside.

    What is beside a line is known by points, which fewer images see than the surface around them; how many fewer is
    known from the images that do show lines.
    """
    seen, marks = scene.line_observations, scene.point_observations
    points = np.unique(marks.point_idx)
    first, last = scene.lines.segments.transpose(1, 0, 2)
    places = (first[:, None] + _PLACES[:, None] * (last - first)[:, None]).reshape(-1, 3)
    beside = np.zeros((scene.num_lines, 0), np.int64)
    if len(points):
        beside = points[nearest(kd_tree(scene.points.xyz[points]), places, 1)[1].reshape(-1, len(_PLACES))]
    lines_of, points_of = (
        _by_image(image, landmark, scene.num_images)
        for image, landmark in ((seen.image_idx, seen.line_idx), (marks.image_idx, marks.point_idx))
    )
    absent, told, shown = np.zeros(scene.num_lines), np.zeros(scene.num_lines), np.zeros(2)
    images_seen = list(zip(range(scene.num_images), lines_of, points_of, strict=True))
    for images, points_told, numbers in map_in_threads(partial(_absent, scene, beside), images_seen):
        absent, told, shown = absent + images, told + points_told, shown + numbers
    usual = shown[0] / max(shown[1], 1.0)
    return absent, np.minimum(ratio(told, usual, usual > 0.0, np.inf), absent)


def _by_image(image: IntArray, landmark: IntArray, num_images: int) -> list[IntArray]:
    order, pointers = grouped(image, num_images)
    return [landmark[order[begin:end]] for begin, end in pairwise(pointers)]


def _absent(
    scene: Scene, beside: IntArray, of_image: tuple[int, IntArray, IntArray]
) -> tuple[BoolArray, IntArray, list[int]]:
    """Return which lines (L,) an image, with the lines and points that it shows, does not show though they lie in its
    frame, how many points beside these it does; and how many beside lines that it shows, with the number of these.
    """
    image, lines, points = of_image
    shown, told = np.zeros(scene.num_lines, np.bool_), np.zeros(scene.num_points, np.bool_)
    shown[lines], told[points] = True, True
    absent, count = _in_frame(scene, image) & ~shown, told[beside].sum(axis=1)
    return absent, count * absent, [int(count[shown].sum()), int(shown.sum())]


def _in_frame(scene: Scene, image: int) -> BoolArray:
    """(L,) lines that lie whole in the frame of an image and are long enough to be found."""
    camera, pose = scene.images.camera_idx[image], scene.cam_from_world[image]
    size = np.array([scene.cameras.width[camera], scene.cameras.height[camera]], float)
    model = camera_model(scene.cameras.models[camera])
    in_cam = quaternion.rotate(pose[:4], scene.lines.segments) + pose[4:]
    places = np.ascontiguousarray(in_cam.reshape(-1, 3))
    pixels = model.project(scene.cameras.params[camera, : model.num_parameters], places).reshape(-1, 4)
    front = np.ones(len(in_cam), bool) if model.sees_behind else (in_cam[..., 2] > 0.0).all(axis=1)
    return front & _inside(pixels, size) & (segment2.length(np.nan_to_num(pixels)) >= MIN_LENGTH)


def _inside(pixels: FloatArray, size: FloatArray) -> BoolArray:
    ends = pixels.reshape(-1, 2, 2)
    inside = ((ends >= 0.0) & (ends <= size)) if size.all() else np.isfinite(ends)
    return np.asarray(inside.all(axis=(1, 2)), np.bool_)
