# SPDX-License-Identifier: BSD-3-Clause
r"""Images that were read row by row: the motion of the camera meanwhile is estimated with everything else.

Six numbers more for each image are much, and points alone do not hold them: where all images are read along the same
direction in the world, motions can flatten or bend the scene without a trace in the residuals. What is known beforehand
holds them, and how well it is known is estimated: the motions v of all images are draws about what is expected of them,
e, with one standard deviation for shifts and one for turns. An adjustment under these gives v, and with the share r of
each number that the images determine (its redundancy as a measurement),

.. math:: \hat\sigma^2 = \frac{\sum (v - e)^2}{\sum r} .

Expected is no motion; or, where the images prove to be a sequence, a share :math:`\lambda` of the motion d from the
image before to the image after: :math:`e = \lambda d`, if it explains the motions better than chance would. Adjustment
and estimate take turns. Motions that explain next to nothing would stand for errors of the calibration: they are left
out, and the images count as taken at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from groma._counted import counted, natural_key
from groma._trees import kd_tree
from groma._typing import FloatArray, IntArray
from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.misfit.lens import LENS
from groma.adjustment.report import AdjustResult, Progress
from groma.adjustment.terms.readout import MOTIONS
from groma.errors import InputError, ProblemError, given_or_default
from groma.gates import NORMAL, chi_square_gate, gate
from groma.geometry import quaternion
from groma.problem.problem import Problem
from groma.scene import CameraMotions, Scene
from groma.scene.motions import COLUMNS, ROWS
from groma.solver.covariance.marginals import Covariances

#: The message where motions are left out.
NOT_ROLLING = (
    "The images show next to no rolling shutter: motions of the cameras explain less than a tenth of the residuals' "
    "variance, and would stand for errors of the calibration. The images count as taken at once."
)
#: What an image may be read along.
AXES = {"rows": ROWS, "columns": COLUMNS}


@dataclass(frozen=True)
class RollingShutterGates:
    """How motions during the readout are held, and when they are told to be uncertain."""

    turn: float = gate(np.radians(3.0), "rad", "deviation of a turn at the start", "convention: 100 degrees a second")
    shift: float = gate(0.3, "times", "distance to the nearest camera, of a shift at the start", "convention: a third")
    smallest: float = gate(1e-3, "times", "the deviation at the start, at least", "cost: smaller ones hold as well")
    settled: float = gate(1.15, "times", "by which deviations change that have settled", "cost: 15 % of a weight")
    max_rounds: int = gate(4, "adjustments", "of a scene", "cost: most need three")
    max_images: int = gate(300, "images", "for which redundancy is computed; of more it is taken as one", "cost: time")
    parallel: float = gate(
        np.radians(30.0), "rad", "between parallel directions of readout", "convention: half of what decides"
    )


GATES = RollingShutterGates()


@dataclass(frozen=True, eq=False)
class Motions:
    """Estimated motions during the readout."""

    #: (N, 6) motions, and (N, 6) the share of each that the images determine, from 0 to 1.
    motion: FloatArray
    redundancy: FloatArray
    #: Standard deviations of shifts (scene units) and turns (radians) about the expected ones.
    sigma: tuple[float, float]
    #: Share of the motion between neighbouring images that is expected; 0 where they are no sequence.
    share: float
    #: Largest angle between the directions of readout of two images, radians.
    spread: float
    #: Share of the residuals' variance that they explain, against a global shutter; None: not computed.
    explained: float | None = None
    #: Whether they explain so little that the result is without them.
    left_out: bool = False

    def sentences(self) -> tuple[str, ...]:
        """Say how the cameras moved."""
        if self.left_out:
            return ()
        shift, turn = (np.linalg.norm(part, axis=1) for part in (self.motion[:, :3], self.motion[:, 3:]))
        told = (
            f"Rolling shutter of {counted(len(shift), 'images')}: while one is read the camera moves by "
            f"{np.median(shift):.3g} units of length (at most {shift.max():.3g}) and turns by "
            f"{np.degrees(np.median(turn)):.2g} degrees (at most {np.degrees(turn.max()):.2g})."
        )
        if not self.share:
            return (told,)
        way = "" if self.share > 0.0 else ", from its last row to its first"
        return told, f"The images are a sequence: reading one takes {abs(self.share):.2g} of the time to the next{way}."

    def warnings(self) -> tuple[str, ...]:
        """Say where motions rest on what was expected of them."""
        if self.left_out:
            return (NOT_ROLLING,)
        told = []
        if self.spread < GATES.parallel:
            told.append(
                f"All images are read along nearly the same direction (within {np.degrees(self.spread):.0f} degrees). "
                "Motions can then flatten or bend the scene without being noticed, and what holds them is what is "
                f"expected: {'the path of the camera' if self.share else 'that they are small'}. Turn the camera by 90 "
                "degrees for some photographs, or measure distances or positions."
            )
        for name, part in (("shifts", slice(0, 3)), ("turns", slice(3, 6))):
            share = float(self.redundancy[:, part].mean())
            if share < NORMAL.majority:
                told.append(
                    f"The {name} of the cameras during the readout rest by {100 * (1.0 - share):.0f} % on what is "
                    "expected of them, not on the images."
                )
        return tuple(told)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values: the entry ``rolling_shutter`` of a summary."""
        shift, turn = (np.linalg.norm(part, axis=1) for part in (self.motion[:, :3], self.motion[:, 3:]))
        return {
            "num_images": len(shift),
            "left_out": self.left_out,
            "shift": {"median": float(np.median(shift)), "largest": float(shift.max())},
            "turn_deg": {"median": float(np.degrees(np.median(turn))), "largest": float(np.degrees(turn.max()))},
            "expected_sigma": {"shift": self.sigma[0], "turn_deg": float(np.degrees(self.sigma[1]))},
            "share_of_interval": self.share or None,
            "explained": self.explained,
            "determined": {"shift": float(self.redundancy[:, :3].mean()), "turn": float(self.redundancy[:, 3:].mean())},
            "notes": list(self.sentences()),
        }


@dataclass(frozen=True, eq=False)
class RollingShutterResult:
    """An adjustment of images that were read row by row; without motions where these are left out."""

    result: AdjustResult
    motions: Motions


def with_rolling_shutter(scene: Scene, along: str = "rows") -> Scene:
    """Return a scene all of whose images have a rolling shutter, with initial motions of zero.

    Parameters
    ----------
    scene : Scene
        With poses; its motions are forgotten.
    along : "rows" or "columns"
        Images are read row by row, or, as photographs that were turned to stand upright, column by column.

    Raises
    ------
    InputError
        If the size of an image is not known, there are fewer than two, or depths were measured.
    """
    if along not in AXES:
        raise InputError(f"A rolling shutter reads along {' or '.join(AXES)}; got {along!r}.")
    if scene.num_images < 2:
        raise InputError(f"A rolling shutter needs at least two images; got {scene.num_images}.")
    if not (np.minimum(scene.cameras.width, scene.cameras.height)[scene.images.camera_idx] > 0).all():
        raise InputError(
            "A rolling shutter needs the size of the images, and a camera has none. Give width and height."
        )
    if scene.is_metric:
        raise InputError(
            "Depths, stereo pairs and measured planes do not support a rolling shutter. Leave --rolling-shutter "
            "out, or adjust the scene without them."
        )
    count, centers = scene.num_images, scene.cam_centers_in_world
    nearest = kd_tree(centers).query(centers, k=2)[0][:, 1]
    apart = float(np.median(nearest[nearest > 0.0])) if (nearest > 0.0).any() else 1.0
    sigma = np.tile(np.repeat([GATES.shift * apart, GATES.turn], 3), (count, 1))
    nothing = np.zeros((count, 6))
    table = CameraMotions(np.arange(count), nothing, nothing, sigma, np.full(count, AXES[along]))
    return scene.replace(camera_motions=table)


def adjust_rolling_shutter(
    scene: Scene, options: AdjustOptions | None = None, progress: Callable[[Progress], bool | None] | None = None
) -> RollingShutterResult:
    """Adjust a scene with motions during the readout, and estimate how well these are known beforehand.

    Parameters
    ----------
    scene : Scene
        With ``camera_motions``, as from :func:`with_rolling_shutter` or an earlier adjustment.
    options, progress
        As for :func:`groma.adjust`.
    """
    options = given_or_default(options, AdjustOptions)
    at_once = adjust(scene.replace(camera_motions=CameraMotions()), options, progress)
    start = scene.camera_motions.sigma[0, [0, 3]]
    quick = replace(options, check_lens=False)
    for _ in range(GATES.max_rounds - 1):
        result = adjust(scene, quick, progress)
        found = motions_of(result.scene, result.problem)
        sigma = np.maximum(found.sigma, GATES.smallest * start)
        before, scene = result.scene.camera_motions, _expecting(result.scene, found.share, sigma)
        ratio = scene.camera_motions.sigma[0] / before.sigma[0]
        if ratio.max() <= GATES.settled and ratio.min() >= 1.0 / GATES.settled:
            break
    result = adjust(scene, options, progress)
    found = motions_of(result.scene, result.problem)
    still, rolling = at_once.report.sigma0, result.report.sigma0
    if still is None or rolling is None:
        return RollingShutterResult(result, found)
    explained = 1.0 - (rolling / still) ** 2
    if explained < LENS.share:
        return RollingShutterResult(at_once, replace(found, explained=explained, left_out=True))
    return RollingShutterResult(result, replace(found, explained=explained))


def motions_of(scene: Scene, problem: Problem | None) -> Motions:
    """Return the motions of an adjusted scene, and their prior for the next adjustment."""
    table = scene.camera_motions
    share_of = _redundancy(problem, table)
    known = np.maximum(share_of, 0.05)
    free = table.expected + (table.motion - table.expected) / known  # as if nothing had been expected
    between = motions_between(scene, table.image_idx)
    share = _share(free, known, between, table.sigma)
    left = share_of**2 * (free - share * between) ** 2
    variance = [left[:, part].sum() / max(share_of[:, part].sum(), 1e-9) for part in (slice(0, 3), slice(3, 6))]
    return Motions(
        table.motion, share_of, (float(np.sqrt(variance[0])), float(np.sqrt(variance[1]))), share, _spread(scene, table)
    )


def motions_between(scene: Scene, image_idx: IntArray) -> FloatArray:
    """Return half of the motions (N, 6) from the image before to the image after, in the order of names.

    In the axes of the camera, as :class:`~groma.scene.motions.CameraMotions` has them; at the ends from one neighbour.
    """
    order = sorted(range(len(image_idx)), key=lambda row: natural_key(scene.images.names[image_idx[row]]))
    poses, centers = scene.cam_from_world[image_idx[order]], scene.cam_centers_in_world[image_idx[order]]
    number = np.arange(len(order))
    before, after = np.maximum(number - 1, 0), np.minimum(number + 1, len(order) - 1)
    steps = (after - before)[:, None]
    shift = quaternion.rotate(poses[:, :4], centers[after] - centers[before]) / steps
    turned = quaternion.multiply(poses[after, :4], quaternion.conjugate(poses[before, :4]))
    out = np.empty((len(order), 6))
    out[order] = np.hstack([shift, -quaternion.log(turned) / steps])
    return out


# ----------------------------------------------------------------------------------------------------------- helpers
def _expecting(scene: Scene, share: float, sigma: FloatArray) -> Scene:
    table = scene.camera_motions
    expected = share * motions_between(scene, table.image_idx)
    spread = np.tile(np.repeat(sigma, 3), (len(table), 1))
    return scene.replace(camera_motions=table.replace(expected=expected, sigma=spread))


def _redundancy(problem: Problem | None, table: CameraMotions) -> FloatArray:
    """Return the share (N, 6) of each number that the images determine; one where that is not known."""
    if problem is None or MOTIONS not in problem.variables or len(table) > GATES.max_images:
        return np.ones((len(table), 6))
    try:
        covariance = Covariances(problem).of_coordinates(MOTIONS)[:-1]
    except ProblemError:
        return np.ones((len(table), 6))
    variance = np.einsum("nii->ni", covariance)
    return np.clip(1.0 - np.where(np.isfinite(variance), variance, np.inf) / table.sigma**2, 0.0, 1.0)


def _share(free: FloatArray, known: FloatArray, between: FloatArray, sigma: FloatArray) -> float:
    """Return the share of the motions between images that explains those during the readout; 0 if chance might."""
    weight = known / sigma**2
    square = float((weight * between**2).sum())
    if not square > 0.0:
        return 0.0
    share = float((weight * between * free).sum()) / square
    gain = 0.0
    for part in (slice(0, 3), slice(3, 6)):
        w, v, d = known[:, part], free[:, part], between[:, part]
        nothing, something = ((w * (v - factor * d) ** 2).sum() for factor in (0.0, share))
        gain += v.size * float(np.log(max(nothing, 1e-300) / max(something, 1e-300)))
    return share if gain > chi_square_gate(NORMAL.gross, 1) else 0.0


def _spread(scene: Scene, table: CameraMotions) -> float:
    """Return the largest angle between directions of readout, as lines without a sign."""
    axes = np.eye(3)[np.where(table.axis == COLUMNS, 0, 1)]
    turned = quaternion.conjugate(scene.cam_from_world[table.image_idx, :4])
    ways = quaternion.rotate(turned, axes)
    return float(np.arccos(np.clip(np.abs(ways @ ways.T).min(), 0.0, 1.0)))
