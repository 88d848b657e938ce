# SPDX-License-Identifier: BSD-3-Clause
r"""How far a trajectory is from a reference: absolute error, relative error, drift over segments.

With poses :math:`P_i` (estimate, after alignment) and :math:`Q_i` (reference), world_from_cam, at the same times:

* **absolute** (ATE): :math:`\lVert p_i - q_i \rVert` of the camera centres;
* **relative** (RPE): for pairs of poses i, j a step apart,
  :math:`E = (Q_i^{-1} Q_j)^{-1} (P_i^{-1} P_j)`; the length of its translation and the angle of its rotation;
* **drift**: the same over segments of given lengths of the reference, divided by the length.

Poses are associated by time: each pose of the shorter trajectory takes the nearest of the longer. Where one of two
trajectories of equal length has no times (KITTI), they are associated by their lines instead. Alignment minimises the
squared absolute errors. Where the positions do not determine the rotation (a straight road, a camera that turns on the
spot), the orientations take part (:func:`~groma.evaluation.alignment.pose_alignment`). Steps in metres are measured
along the aligned estimate, and steps do not overlap. Absolute and relative error are those of the program *evo* with
the same options.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.errors import InputError, check_kind
from groma.evaluation.alignment import pose_alignment
from groma.evaluation.gates import SCORES
from groma.evaluation.poses import rotation_angle, unrelated
from groma.gates import NORMAL
from groma.geometry import quaternion, se3
from groma.io.trajectories import Trajectory
from groma.scene import Similarity

Alignment = Literal["se3", "sim3", "none"]
StepUnit = Literal["frames", "metres", "seconds"]

#: Lengths of the segments of the KITTI odometry benchmark, metres, and the step between their first poses.
SEGMENT_LENGTHS, SEGMENT_STEP = SCORES.segment_lengths, SCORES.segment_step


@dataclass(frozen=True)
class Spread:
    """Statistics of a set of errors."""

    rmse: float
    mean: float
    median: float
    max: float

    @classmethod
    def of(cls, errors: FloatArray) -> Spread:
        """Summarise errors (N,), at least one."""
        return cls(
            float(np.sqrt(np.mean(errors**2))), float(errors.mean()), float(np.median(errors)), float(errors.max())
        )


@dataclass(frozen=True, eq=False)
class TrajectoryScores:
    """Errors of a trajectory; lengths in units of the reference, which are metres in most data."""

    #: Distances of the camera centres.
    ate: Spread
    #: Angles between the orientations after alignment, degrees.
    rotation_deg: Spread
    #: Translation and rotation (degrees) of the relative errors; None if no two poses are a step apart.
    rpe_translation: Spread | None
    rpe_rotation_deg: Spread | None
    #: Number of pairs behind the relative errors.
    num_pairs: int
    #: Mean relative translation error over the segments, percent, and rotation error, degrees by unit of length;
    #: None if the reference moves no farther
    #: than its positions err after an alignment.
    drift_percent: float | None
    drift_deg_per_metre: float | None
    #: Lengths of the segments: those of the KITTI benchmark, or tenths of a path shorter than 100.
    segment_lengths: tuple[float, ...]
    #: How the estimate was aligned: ``se3``, ``sim3`` or ``none``.
    alignment: Alignment
    #: Whether orientations took part in it, as the positions alone do not determine the rotation.
    by_orientations: bool
    #: ``reference_from_estimate``: the alignment that was applied; its scale is one unless ``sim3``.
    similarity: Similarity = field(repr=False)
    #: Number of poses that were compared, and of poses in the two trajectories.
    num_poses: int
    num_estimate: int
    num_reference: int
    #: ``time``, or ``line`` where one side has no times and both have as many lines.
    association: Literal["time", "line"]
    #: Sentences about what makes the scores unreliable.
    warnings: tuple[str, ...]
    #: Length of the path of the reference over the compared poses.
    path_length: float
    #: (N,) times of the compared poses; (N, 7) aligned estimate and reference, world_from_cam; (N,) distances.
    timestamps: FloatArray = field(repr=False)
    aligned: FloatArray = field(repr=False)
    reference: FloatArray = field(repr=False)
    errors: FloatArray = field(repr=False)

    def to_dict(self) -> dict[str, object]:
        """Return the scores for a machine-readable report, without the arrays."""
        result: dict[str, object] = {}
        for name in ("ate", "rotation_deg", "rpe_translation", "rpe_rotation_deg"):
            spread: Spread | None = getattr(self, name)
            for key in ("rmse", "mean", "median", "max"):
                result[f"{name}_{key}"] = None if spread is None else getattr(spread, key)
        result["scale"] = self.similarity.scale
        for name in ("alignment", "by_orientations", "num_poses", "num_estimate", "num_reference", "num_pairs"):
            result[name] = getattr(self, name)
        result["path_length"] = self.path_length
        result["drift_percent"], result["drift_deg_per_metre"] = self.drift_percent, self.drift_deg_per_metre
        result["association"], result["warnings"] = self.association, list(self.warnings)
        result["segment_lengths"] = list(self.segment_lengths)
        return result


def score_trajectory(
    estimate: Trajectory,
    reference: Trajectory,
    align: Alignment = "se3",
    max_time_difference: float = SCORES.time_difference,
    rpe_delta: float = 1.0,
    rpe_unit: StepUnit = "frames",
) -> TrajectoryScores:
    r"""Compare a trajectory with a reference.

    .. math:: \mathrm{ATE} = \sqrt{\tfrac{1}{N} \sum_i \lVert s R p_i + t - q_i \rVert^2}

    Parameters
    ----------
    estimate, reference : Trajectory
        world_from_cam of the same camera; the worlds may differ by what ``align`` allows.
    align : str
        ``se3``: a rotation and a translation; ``sim3``: a scale too (monocular); ``none``: compare as they are.
    max_time_difference : float
        Poses are associated if their times differ by no more, seconds.
    rpe_delta : float
        The step of the relative errors.
    rpe_unit : str
        Its unit: ``frames`` (associated poses), ``metres`` along the aligned estimate, or ``seconds``.

    Returns
    -------
    TrajectoryScores
        Absolute and relative errors, drift, and the associated poses.

    Raises
    ------
    InputError
        If an option is unknown or no pose can be associated.

    References
    ----------
    J. Sturm et al., *A benchmark for the evaluation of RGB-D SLAM systems*, 2012; A. Geiger et al., *Are we ready for
    autonomous driving?*, 2012.
    """
    for name, given in (("estimate", estimate), ("reference", reference)):
        check_kind(given, Trajectory, name, "Read one with groma.read_trajectory(path).")
    if align not in ("se3", "sim3", "none"):
        raise InputError(f"align must be 'se3', 'sim3' or 'none'; got {align!r}.")
    if rpe_unit not in ("frames", "metres", "seconds"):
        raise InputError(f"rpe_unit must be 'frames', 'metres' or 'seconds'; got {rpe_unit!r}.")
    if not (np.isfinite(rpe_delta) and rpe_delta > 0) or (rpe_unit == "frames" and rpe_delta != int(rpe_delta)):
        raise InputError(f"rpe_delta must be positive, and a whole number of frames; got {rpe_delta} {rpe_unit}.")
    ours, theirs = in_order(estimate), in_order(reference)
    by_line = len(ours) == len(theirs) and (counts_lines(ours) or counts_lines(theirs))
    every = np.arange(len(ours))
    i, j = (every, every) if by_line else associate(ours.timestamps, theirs.timestamps, max_time_difference)
    if len(i) == 0:
        raise InputError(_no_match(ours, theirs, max_time_difference))
    times, poses, truth = ours.timestamps[i], ours.world_from_cam[i], theirs.world_from_cam[j]
    similarity, by_orientations = Similarity(), False
    if align != "none":
        found = pose_alignment(se3.inverse(poses), se3.inverse(truth), align == "sim3")
        similarity, by_orientations = found.similarity, found.by_orientations
    aligned = apply_similarity(similarity, poses)

    errors = np.linalg.norm(aligned[:, 4:] - truth[:, 4:], axis=1)
    angles = rotation_angle(aligned[:, :4], truth[:, :4])
    first, second = _steps(times, aligned[:, 4:], float(rpe_delta), rpe_unit)
    translation, rotation = _relative_errors(aligned, truth, first, second)
    drift, turn, lengths, path = _drift(aligned, truth)
    if align != "none" and np.linalg.norm(errors) >= np.linalg.norm(truth[:, 4:] - truth[:, 4:].mean(axis=0)):
        drift, turn, lengths = None, None, ()  # its way is no longer than the noise of its positions
    doubts = (
        _few_in_common(ours, theirs, len(i)),
        unrelated(errors, truth[:, 4:], np.degrees(angles)),
        _another_scale(poses, truth, errors) if align == "se3" else None,
    )
    return TrajectoryScores(
        ate=Spread.of(errors),
        rotation_deg=Spread.of(np.degrees(angles)),
        rpe_translation=Spread.of(translation) if len(first) else None,
        rpe_rotation_deg=Spread.of(np.degrees(rotation)) if len(first) else None,
        num_pairs=len(first),
        drift_percent=drift,
        drift_deg_per_metre=turn,
        segment_lengths=lengths,
        alignment=align,
        by_orientations=by_orientations,
        similarity=similarity,
        num_poses=len(i),
        num_estimate=len(estimate),
        num_reference=len(reference),
        association="line" if by_line else "time",
        warnings=tuple(doubt for doubt in doubts if doubt),
        path_length=path,
        timestamps=times,
        aligned=aligned,
        reference=truth,
        errors=errors,
    )


def associate(
    first: npt.ArrayLike, second: npt.ArrayLike, max_time_difference: float = SCORES.time_difference
) -> tuple[IntArray, IntArray]:
    """Associate two increasing series of times: each time of the shorter takes the nearest of the longer.

    Parameters
    ----------
    first, second : (N,) and (M,) float
        Times, seconds, increasing. Of two equally near the earlier is taken; one time may be taken twice.
    max_time_difference : float
        Largest difference, seconds.

    Returns
    -------
    (K,) and (K,) int
        Rows of ``first`` and of ``second``, in order of time.

    Raises
    ------
    InputError
        If the largest difference is negative or no number.
    """
    if not max_time_difference >= 0.0:
        raise InputError(
            f"max_time_difference must be a number of seconds, not negative; got {max_time_difference}. Half of the "
            "time between two poses is usual."
        )
    a, b = np.asarray(first, float), np.asarray(second, float)
    if len(b) > len(a):
        return _nearest(a, b, max_time_difference)
    j, i = _nearest(b, a, max_time_difference)
    return i, j


def counts_lines(trajectory: Trajectory) -> bool:
    """Whether the times are the numbers of the lines 0, 1, ..., as in a file without times."""
    return len(trajectory) > 0 and bool((trajectory.timestamps == np.arange(len(trajectory))).all())


def in_order(trajectory: Trajectory) -> Trajectory:
    """Return the poses in order of time."""
    if (np.diff(trajectory.timestamps) >= 0).all():
        return trajectory
    return trajectory.take(np.argsort(trajectory.timestamps, kind="stable"))


def apply_similarity(new_from_old: Similarity | FloatArray, world_from_cam: npt.ArrayLike) -> FloatArray:
    r"""Return poses (N, 7) in another world: :math:`R' = R_s R`, :math:`t' = s R_s t + t_s`."""
    if not isinstance(new_from_old, Similarity):
        new_from_old = Similarity.from_array(new_from_old)
    poses = np.asarray(world_from_cam, float)
    turn = np.broadcast_to(quaternion.from_matrix(new_from_old.rotation), poses[:, :4].shape)
    turned = quaternion.normalize(quaternion.multiply(turn, poses[:, :4]))
    return np.hstack([turned, new_from_old.points(poses[:, 4:])])


# --------------------------------------------------------------------------------------------------------- Details


def _nearest(times: FloatArray, among: FloatArray, limit: float) -> tuple[IntArray, IntArray]:
    """Return rows of ``times`` and their nearest rows of ``among``, where near enough."""
    if len(times) == 0 or len(among) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    after = np.searchsorted(among, times).clip(1, max(len(among) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(among) - 1)
    chosen = np.where(np.abs(among[after] - times) < np.abs(times - among[before]), after, before)
    near = np.flatnonzero(np.abs(among[chosen] - times) <= limit)
    return near, chosen[near]


def _no_match(estimate: Trajectory, reference: Trajectory, limit: float) -> str:
    if len(estimate) == 0 or len(reference) == 0:
        return f"A trajectory without poses: {len(estimate)} estimated, {len(reference)} of the reference."
    a, b = estimate.timestamps, reference.timestamps
    return (
        f"No two poses are within {limit:g} s: the estimate runs from {a[0]:.6f} to {a[-1]:.6f}, the reference from "
        f"{b[0]:.6f} to {b[-1]:.6f}. Check the units of time, or allow a larger difference."
    )


def _few_in_common(estimate: Trajectory, reference: Trajectory, count: int) -> str | None:
    """Return a sentence where fewer poses are associated than should be."""
    if count >= NORMAL.majority * min(len(estimate), len(reference)):
        return None
    numbered = [name for name, side in (("EST", estimate), ("REF", reference)) if counts_lines(side)]
    hint = "check the units of time, or allow a larger difference"
    if numbered:
        hint = f"{' and '.join(numbered)} has no times but the numbers of its lines; give them (--times)"
    return (
        f"Only {count:,} of {len(estimate):,} and {len(reference):,} poses are associated, perhaps wrongly: the scores "
        f"are of these alone. By their times the two hardly overlap; {hint}."
    )


def _another_scale(poses: FloatArray, truth: FloatArray, errors: FloatArray) -> str | None:
    """Return a sentence where most of the error is one of scale."""
    if len(poses) < 3:
        return None
    found = pose_alignment(se3.inverse(poses), se3.inverse(truth)).similarity
    left = np.linalg.norm(apply_similarity(found, poses)[:, 4:] - truth[:, 4:], axis=1)
    before, after = (Spread.of(distances).rmse for distances in (errors, left))
    if after > SCORES.but_for_scale * before or abs(found.scale - 1.0) < 1e-9:  # of equal ones rounding is left
        return None
    return (
        f"Most of the error is one of scale: with the estimate times {found.scale:.4g} the position error would be "
        f"{after:.4g}. A single camera does not know its scale: --align sim3."
    )


def _steps(times: FloatArray, centers: FloatArray, delta: float, unit: StepUnit) -> tuple[IntArray, IntArray]:
    """Return the first and last poses of steps that do not overlap."""
    if unit == "frames":
        chosen = np.arange(0, len(times), int(delta))
        return chosen[:-1], chosen[1:]
    along = times - times[0]
    if unit == "metres":
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centers, axis=0), axis=1))])
    else:
        delta *= 1.0 - 1e-9  # times such as 0.1, 0.2, 0.3 are not multiples of each other
    chosen = [0]
    while True:
        # Summed from the last pose on, so that rounding does not depend on where the step lies.
        following = int(np.argmax(along[chosen[-1] :] - along[chosen[-1]] >= delta)) + chosen[-1]
        if following == chosen[-1]:
            break
        chosen.append(following)
    rows = np.asarray(chosen)
    return rows[:-1], rows[1:]


def _relative_errors(
    poses: FloatArray, truth: FloatArray, first: IntArray, second: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return the lengths and angles (radians) of the relative errors of pairs."""
    ours = se3.compose(se3.inverse(poses[first]), poses[second])
    theirs = se3.compose(se3.inverse(truth[first]), truth[second])
    # The rotation before it does not change the length of the translation.
    return np.linalg.norm(ours[:, 4:] - theirs[:, 4:], axis=1), rotation_angle(ours[:, :4], theirs[:, :4])


def _drift(poses: FloatArray, truth: FloatArray) -> tuple[float | None, float | None, tuple[float, ...], float]:
    """Return mean errors over segments by length (percent, degrees per unit), the lengths, and the path's length."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth[:, 4:], axis=0), axis=1))])
    path = float(along[-1])
    if path > SEGMENT_LENGTHS[0]:
        lengths, step = tuple(length for length in SEGMENT_LENGTHS if length < path), SEGMENT_STEP
    else:
        lengths, step = tuple(path * tenths / 10 for tenths in range(1, 9)), 1
    starts = np.arange(0, len(along), step)
    first, second, by = [], [], []
    for length in lengths:
        ends = np.searchsorted(along, along[starts] + length, side="right")
        inside = ends < len(along)
        first.append(starts[inside])
        second.append(ends[inside])
        by.append(np.full(int(inside.sum()), length))
    rows = np.concatenate(first).astype(np.int64)
    if path == 0.0 or len(rows) == 0:
        return None, None, (), path
    translation, rotation = _relative_errors(poses, truth, rows, np.concatenate(second).astype(np.int64))
    size = np.concatenate(by)
    return float((translation / size).mean() * 100), float(np.degrees(rotation / size).mean()), lengths, path
