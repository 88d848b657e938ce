# SPDX-License-Identifier: BSD-3-Clause
"""Points of photographs at poses from elsewhere, and better poses in their frame.

1. Features are matched; every pair of images gives a motion (:mod:`~groma.mapping.posed.motions`).
2. The axes of the given poses are compared with the motions (:mod:`~groma.mapping.posed.axes`).
3. Motions and given poses together give poses (:mod:`~groma.mapping.posed.averaging`), the noise of the given ones, and
   those that no noise explains.
4. Points are triangulated there, first with a wide tolerance, then with COLMAP's. Images that see too few are placed by
   the points of the others. Everything is adjusted with the given poses as measurements.
5. Noise and gross errors are found again, now against the adjusted poses (:mod:`~groma.mapping.posed.noise`).

Out come a scene whose table of pose priors holds the given poses without gross errors, at their noise, and what there
is to say. Images that see too few points are not in it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.adjustment.adjust import AdjustOptions, adjust
from groma.errors import InputError, ProblemError
from groma.gates import gate
from groma.geometry import quaternion, se3
from groma.io.colmap.at_poses import MIN_MATCHES, PosedPhotographs
from groma.io.colmap.sfm import PointModelOptions
from groma.mapping.noise.observations import noise_px
from groma.mapping.posed.axes import check_axes
from groma.mapping.posed.motions import Motions, motions_of
from groma.mapping.posed.noise import GivenNoise, noise_of_given
from groma.mapping.posed.registered import RegisteredPhotographs
from groma.mapping.posed.sentences import about_contradiction, about_gross_errors, about_left_out, about_noise
from groma.scene import PosePriors, Scene, Similarity
from groma.scene.local_frame import usual_frame
from groma.scene.table import new_index_of
from groma.solver.covariance.marginals import Covariances

Say = Callable[[str, int, int], None]


@dataclass(frozen=True)
class PlacingGates:
    """How points are found at poses that are not exact yet."""

    tolerances_px: tuple[float, ...] = gate(
        (24.0, 4.0), "px", "largest reprojection error, round by round", "convention: COLMAP's, before it 6 x"
    )
    absolute_px: float = gate(12.0, "px", "tolerance of an image placed by points", "convention: COLMAP")


GATES = PlacingGates()


@dataclass(frozen=True, eq=False)
class GivenPoses:
    """What is known about the given poses of N images."""

    #: (N, 7) the poses, cam_from_world.
    poses: FloatArray
    #: Noise and gross errors of their places and of their orientations.
    place: GivenNoise
    turn: GivenNoise
    #: Standard deviations to use: scene units and radians.
    sigma: tuple[float, float]

    @property
    def gross(self) -> BoolArray:
        """(N,) which are wrong."""
        return self.place.gross | self.turn.gross

    def priors(self) -> PosePriors:
        """Return the poses without gross errors as measurements of the frames of the same rows."""
        rows = np.flatnonzero(~self.gross)
        return PosePriors(rows, self.poses[rows], np.tile(np.repeat(self.sigma, 3), (len(rows), 1)))


def register_photographs(
    images: Path,
    work: Path,
    given: Scene,
    options: PointModelOptions,
    refine_poses: bool = True,
    refine_intrinsics: bool = False,
    max_iterations: int = 50,  # derived from MapOptions
    say: Say = lambda doing, done, total: None,
) -> RegisteredPhotographs:
    """Find points and better poses of photographs.

    Parameters
    ----------
    images : Path
        Folder of the photographs.
    work : Path
        Folder for features and matches; finished work in it is not repeated.
    given : Scene
        Cameras, names and poses. Every image is taken for itself, also where frames of rigs hold several.
    options : PointModelOptions
        Seed and threads.
    refine_poses : bool
        Better the poses; else points are placed at them as they are.
    refine_intrinsics : bool
        Estimate the calibration too.
    max_iterations : int
        Most steps of each adjustment.
    say : callable
        Called with a name, the number of parts done, and their total.

    Raises
    ------
    InputError
        If the photographs do not match each other, or contradict the axes of the poses.
    """
    alone = _standalone(given)
    near = usual_frame(alone)
    scene = alone if near is None else alone.transformed(near)
    photographs = PosedPhotographs(images, work, scene, options)
    photographs.match(say)
    motions = motions_of(photographs.pairs())
    _check_motions(motions, scene)
    check_axes(alone, motions)
    if not refine_poses:
        say("placing points at the poses", 0, 1)
        return _told(photographs.triangulate(scene, GATES.tolerances_px[-1]), None, near)
    found, known = more_seen(photographs, scene, *averaged(scene, motions), motions)
    rounds = len(GATES.tolerances_px)
    how = AdjustOptions(
        lines=False,
        planes=False,
        refine_intrinsics=refine_intrinsics,
        check_lens=False,
        max_iterations=max_iterations,
        threads=options.threads,
    )
    for number, tolerance in enumerate(GATES.tolerances_px):
        say("placing points at the poses", number, rounds)
        found = _with_missing_registered(photographs, photographs.triangulate(found, tolerance))
        found, known = _adjusted(found, known, how, number > 0)
    return _told(found, known, near)


def _told(found: Scene, known: GivenPoses | None, near: Similarity | None) -> RegisteredPhotographs:
    """Return the images that see points, in the frame of the given poses, with messages."""
    names, seen = found.images.names, _num_points_seen(found) >= MIN_MATCHES
    if seen.sum() < 2:
        raise InputError(
            "No points could be placed: the photographs match each other, and their matches meet nowhere at the given "
            "poses or near them. Check that names and poses belong together, and the calibration."
        )
    notes, warnings = [], about_left_out(names, seen)
    if known is not None:
        unit = 1.0 if near is None else 1.0 / near.scale
        notes = about_noise(known.place.sigma, known.turn.sigma, unit, int((seen & ~known.gross).sum()))
        warnings = about_gross_errors(names, known.gross & seen, found, known.poses, unit) + warnings
        warnings = about_contradiction(known.turn.sigma) + warnings
        found = found.replace(pose_priors=known.priors())
    found = found.subset(np.flatnonzero(seen), min_observations=2)
    return RegisteredPhotographs(
        found if near is None else found.transformed(near.inverse()), tuple(notes), tuple(warnings)
    )


def averaged(scene: Scene, motions: Motions) -> tuple[Scene, GivenPoses]:
    """Return the scene with poses that agree with motions, too, and the noise of its own."""
    from groma.mapping.posed.averaging import average_centers, average_rotations  # sparse matrices are slow to import

    poses, centers = scene.cam_from_world, scene.cam_centers_in_world
    turned = average_rotations(poses[:, :4], motions)
    moving = np.bincount(np.concatenate([motions.first, motions.second]), minlength=len(poses)) > 0
    turn = noise_of_given(np.sum(turned.residual**2, axis=1), turned.redundancy * moving)
    placed = average_centers(centers, turned.values, motions, ~turn.gross)
    place = noise_of_given(np.sum(placed.residual**2, axis=1), np.where(turn.gross, 0.0, placed.redundancy) * moving)
    new = np.hstack([turned.values, -quaternion.rotate(turned.values, placed.values)])
    sigma = (place.sigma or placed.sigma, turn.sigma or turned.sigma)
    return scene.with_poses(new), GivenPoses(poses, place, turn, sigma)


def more_seen(
    photographs: PosedPhotographs, given: Scene, found: Scene, known: GivenPoses, motions: Motions
) -> tuple[Scene, GivenPoses]:
    """Return averaged poses, or the given ones if both differ by more than motions say and more matches meet at these.

    Where an object looks alike from several sides most motions can be wrong, and agree with each other; of a long lens
    they can be off by far more than they say.
    """
    turn, way = float(np.median(motions.rotation_sigma)), float(np.median(motions.direction_sigma))
    if known.turn.sigma is None or known.turn.sigma <= turn:
        return found, known
    seen = [len(photographs.triangulate(one, GATES.tolerances_px[-1]).point_observations) for one in (given, found)]
    if seen[0] <= seen[1]:
        return found, known
    centers = given.cam_centers_in_world
    apart = float(np.median(np.linalg.norm(centers[motions.first] - centers[motions.second], axis=1)))
    clean = GivenNoise(None, np.zeros(given.num_images, bool))
    return given, GivenPoses(known.poses, clean, clean, (apart * way, turn))


def _adjusted(scene: Scene, known: GivenPoses, options: AdjustOptions, last: bool) -> tuple[Scene, GivenPoses]:
    """Return the scene adjusted with the given poses as measurements, and their estimated noise."""
    if last:
        options = replace(options, point_sigma_px=noise_px(scene.replace(pose_priors=PosePriors()), "points"))
    result = adjust(scene.replace(pose_priors=known.priors()), options)
    if result.problem is None:
        return result.scene, known
    try:
        covariance = Covariances(result.problem).of_coordinates("frames")
    except ProblemError:  # groups of images that nothing but wrong matches ties together: what was known stays
        return result.scene, known
    return result.scene, _compared(result.scene.cam_from_world, covariance, known)


def _compared(poses: FloatArray, covariance: FloatArray, known: GivenPoses) -> GivenPoses:
    """Return the noise of the given poses, by adjusted ones (N, 7) with covariances (N, 6, 6)."""
    between = se3.log(se3.compose(poses, se3.inverse(known.poses)))
    told, sigma = [], []
    for part, before in zip((slice(0, 3), slice(3, 6)), known.sigma, strict=True):
        share = np.einsum("nii->n", covariance[:, part, part]) / (3.0 * before**2)  # derived from three coordinates
        # What took part shows less than its error; what did not shows that of the adjusted pose too.
        redundancy = np.where(known.gross, 1.0 + share, np.clip(1.0 - share, 0.0, 1.0))
        redundancy = np.where(np.isfinite(redundancy), redundancy, 0.0)
        noise = noise_of_given(np.sum(between[:, part] ** 2, axis=1), redundancy)
        told.append(noise)
        sigma.append(noise.sigma or before)
    return GivenPoses(known.poses, told[0], told[1], (sigma[0], sigma[1]))


def _with_missing_registered(photographs: PosedPhotographs, scene: Scene) -> Scene:
    """Return the scene with images that see too few points placed by the points of the others."""
    poses = scene.cam_from_world
    for row in np.flatnonzero(_num_points_seen(scene) < MIN_MATCHES).tolist():
        answer = photographs.place(row, scene, GATES.absolute_px)
        if answer is not None:
            poses[row] = answer[0]
    return scene.with_poses(poses)


def _num_points_seen(scene: Scene) -> IntArray:
    return np.bincount(scene.point_observations.image_idx, minlength=scene.num_images)


def _standalone(given: Scene) -> Scene:
    """Return the images of a scene with poses and cameras alone, numbered from one in the order of their names."""
    order = sorted(range(given.num_images), key=lambda row: given.images.names[row])
    used, camera_idx = np.unique(given.images.camera_idx[order], return_inverse=True)
    cameras = given.cameras.take(used).replace(ids=np.arange(len(used)) + 1)
    names = [given.images.names[row] for row in order]
    priors = given.principal_point_priors.renumbered({"cameras": new_index_of(used, given.num_cameras)})[0]
    poses = given.cam_from_world[order]
    return Scene.from_images(cameras, names, camera_idx, poses, principal_point_priors=priors)


def _check_motions(motions: Motions, scene: Scene) -> None:
    if len(motions) < 2:
        raise InputError(
            f"{len(motions)} pairs of the {scene.num_images} photographs match each other; points need more. They "
            "overlap too little, or show too little texture: take more, from places some steps apart."
        )
