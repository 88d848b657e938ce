# SPDX-License-Identifier: BSD-3-Clause
"""Errors of the poses and calibrations of a map: what they are, that queries know of them, and where none are told."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from groma.adjustment.assemble import assemble, disassemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.terms.principal_points import GATES as PRINCIPAL_POINTS
from groma.adjustment.terms.principal_points import near_the_middle
from groma.evaluation.alignment import align_points
from groma.geometry import quaternion, se3
from groma.localization.errors.common_errors import GATES, CommonErrors, common_errors
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.free_lens import free_lens
from groma.localization.pose.hypotheses import max_errors
from groma.localization.pose.matches import Matches
from groma.localization.pose.records import landmark_covariances
from groma.localization.pose.refinement import refine
from groma.scene import Relations, Scene
from groma.scene.synthetic import holistic
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

NOISE = 0.5
EXACT = SolverOptions(max_iterations=60, function_tolerance=1e-9)
HELD = AssemblyOptions(refine_poses=False, point_chart="euclidean", gauge="free")
FREE = AssemblyOptions(refine_intrinsics=True, refine_principal_point=None, gauge="free")


@dataclass
class _Map:
    """A map of all images but one, adjusted with its calibration, and that image."""

    truth: Scene
    scene: Scene
    query: int
    mapped: np.ndarray
    matches: Matches
    landmarks: tuple[np.ndarray, np.ndarray]

    @property
    def camera(self):
        return QueryCamera.of(self.truth.cameras, 0)

    def errors(self, **changes) -> CommonErrors | None:
        return common_errors(self.scene, self.scene, (1.0, 1.0), (True, True), **changes)[0]

    def in_truth(self, pose):
        """A pose in the world of the truth, by the centres of the map."""
        found = align_points(self.scene.cam_centers_in_world, self.truth.cam_centers_in_world[self.mapped])
        R, t = quaternion.to_matrix(pose[None, :4])[0], pose[4:]
        turned = R @ found.rotation.T
        center = found.scale * found.rotation @ (-R.T @ t) + found.translation
        return np.concatenate([quaternion.from_matrix(turned[None])[0], -turned @ center])

    def start(self):
        """The true pose, in the world of the map: it is near its truth."""
        return self.truth.cam_from_world[self.query]

    def normalised(self, pose, covariance):
        true = self.truth.cam_from_world[self.query][None]
        error = se3.log(se3.compose(true, se3.inverse(self.in_truth(pose)[None])))[0]
        return error @ np.linalg.solve(covariance, error) / 6.0


@cache
def _map(seed, num_images=8, is_unknown=False):
    rng = np.random.default_rng(seed)
    truth = holistic(num_images, seed, noise_px=0.0).truth.keep(planes=[], directions=[]).replace(relations=Relations())
    points, lines = truth.point_observations, truth.line_observations
    noisy = truth.replace(
        point_observations=points.replace(
            pixel=points.pixel + rng.normal(0.0, NOISE, points.pixel.shape), sigma=np.full(len(points), NOISE)
        ),
        line_observations=lines.replace(
            segment=lines.segment + rng.normal(0.0, NOISE, lines.segment.shape), sigma=np.full(len(lines), NOISE)
        ),
    )
    if is_unknown:
        off = PRINCIPAL_POINTS.centred * truth.cameras.width[0] * np.random.default_rng(1000 + seed).normal(size=2)
        points, lines = noisy.point_observations, noisy.line_observations
        noisy = noisy.replace(
            point_observations=points.replace(pixel=points.pixel + off),
            line_observations=lines.replace(segment=lines.segment + np.tile(off, 2)),
        )
        truth, noisy = truth.with_params(np.add(truth.cameras.params, [0.0, 0.0, *off])), near_the_middle(noisy)
    query = int(rng.integers(num_images))
    mapped = np.setdiff1d(np.arange(num_images), [query])
    part = noisy.subset(mapped)
    scene = disassemble(part, solve(assemble(part, FREE).problem, EXACT).problem)
    covariances, rows, landmarks = [], [], []
    for kind, other in (("points", "lines"), ("lines", "points")):
        covariance = landmark_covariances(
            assemble(scene.keep(**{other: []}), HELD).problem, kind, len(getattr(scene, kind))
        )
        table = getattr(noisy, f"{kind[:-1]}_observations")
        seen = np.flatnonzero(table.image_idx == query)
        ids = getattr(noisy, kind).ids[getattr(table, f"{kind[:-1]}_idx")[seen]]
        place = {int(number): row for row, number in enumerate(getattr(scene, kind).ids)}
        landmark = np.array([place.get(int(number), -1) for number in ids], np.int64)
        known = (landmark >= 0) & np.isfinite(np.append(covariance[:, 0, 0], np.nan)[landmark])
        covariances.append(covariance[landmark[known]])
        rows.append(seen[known])
        landmarks.append(landmark[known])
    matches = Matches(
        noisy.point_observations.pixel[rows[0]], scene.points.xyz[landmarks[0]],
        noisy.line_observations.segment[rows[1]].reshape(-1, 2, 2), scene.lines.segments[landmarks[1]],
        np.full(len(rows[0]), NOISE), np.full(len(rows[1]), NOISE), *covariances,
    )  # fmt: skip
    return _Map(truth, scene, query, mapped, matches, (landmarks[0], landmarks[1]))


@pytest.mark.kernels
@pytest.mark.compiled
@pytest.mark.parametrize("calibration", ["that of the map", "that of the map, not given", "its own", "unknown"])
def test_queries_are_as_uncertain_as_the_map(calibration):
    """Squared errors of six degrees: 24 queries have a mean of 1 with a standard deviation of 0.12; without the errors
    of poses and calibration they are told to be far better than they are.
    """
    knowing, plain = [], []
    for seed in range(24):
        world = _map(seed, is_unknown="not given" in calibration)
        errors = world.errors()
        assert errors is not None
        of_map = calibration.startswith("that of the map")
        camera = QueryCamera.of(world.scene.cameras, 0) if of_map else world.camera
        if calibration == "unknown":
            off = (
                PRINCIPAL_POINTS.centred * camera.width * np.random.default_rng(seed).normal(size=2)
            )  # the prior is true
            camera = replace(camera, params=camera.params * [1.02, 1.02, 1.0, 1.0] + [0.0, 0.0, *off])
        lens = free_lens(camera, "all" if calibration == "unknown" else "none")
        limit = max_errors(world.matches)
        found = refine(camera, world.matches, world.start(), limit, lens, gathered=True)
        own = 0 if of_map else None
        noise = found.covariance(world.matches)
        common = errors.of_query(found, world.landmarks, own)[:6, :6]
        knowing.append(world.normalised(found.pose, noise + common))
        plain.append(world.normalised(found.pose, noise))
    assert 0.76 < np.mean(knowing) < 1.24, (np.mean(knowing), np.mean(plain))
    if calibration != "unknown":  # of a lens that is not known more is open than what the map adds
        assert np.mean(plain) > 1.3


@pytest.mark.kernels
def test_what_a_query_is_off_by_follows_the_map():
    """Landmarks are estimated from a pose or a focal length a little off, held: they and the query follow as told."""
    world = _map(3)
    errors = world.errors()
    assert errors is not None
    found = refine(world.camera, world.matches, world.start(), max_errors(world.matches), gathered=True)
    rng = np.random.default_rng(0)
    frames = world.scene.num_frames
    for direction in ("pose", "lens", "lens of both"):
        step = np.zeros(len(errors.covariance))
        if direction == "pose":
            step[6 * 2 : 6 * 2 + 6] = 1e-4 * rng.normal(size=6)
        else:
            step[6 * frames : 6 * frames + 2] = 0.1
        alone = replace(errors, covariance=np.outer(step, step))
        shared = direction == "lens of both"
        told = alone.of_query(found, world.landmarks, 0 if shared else None)
        moved = _moved(world, step)
        camera = replace(world.camera, params=world.camera.params + shared * step[6 * frames :])
        other = refine(camera, moved, found.pose, max_errors(moved), gathered=True)
        way = se3.log(se3.compose(other.pose[None], se3.inverse(found.pose[None])))[0]
        size = np.sqrt(np.trace(alone.of_query(found, world.landmarks)))
        assert size > 1e-6
        # Robust weights and covariances of landmarks, which move as well, change it by some hundredths of what the map
        # does; a query with the calibration of the map moves by a tenth of that.
        np.testing.assert_allclose(np.outer(way, way) / size**2, told / size**2, atol=0.15)


@pytest.mark.kernels
def test_an_error_of_the_calibration_that_a_query_shares_is_in_how_far_its_own_lens_is_from_it():
    """Where the landmarks stay, a query finds its own focal length and pose, whatever the map says of the former."""
    world = _map(3)
    errors = world.errors()
    assert errors is not None
    still = [replace(one, motion=np.zeros_like(one.motion)) for one in (errors.points, errors.lines)]
    lens, limit = free_lens(world.camera, "focal"), max_errors(world.matches)
    found = refine(world.camera, world.matches, world.start(), limit, lens, gathered=True)
    step = np.zeros(len(errors.covariance))
    step[6 * world.scene.num_frames :][:2] = 0.01 * found.camera.params[:2]
    alone = replace(errors, covariance=np.outer(step, step), points=still[0], lines=still[1])
    told = alone.of_query(found, world.landmarks, 0)
    np.testing.assert_allclose(told, np.diag([0.0] * 6 + [0.01**2]), atol=1e-9)
    assert not alone.of_query(found, world.landmarks).any()


def _moved(world, step):
    """The matches with the landmarks that other poses and calibrations give."""
    scene, frames = world.scene, world.scene.num_frames
    twist = step[: 6 * frames].reshape(frames, 6)
    poses = se3.compose(se3.exp(twist), scene.cam_from_world)
    cameras = scene.cameras.replace(params=scene.cameras.params + step[6 * frames :])
    other = scene.with_poses(poses).replace(cameras=cameras)
    xyz = solve(assemble(other.keep(lines=[]), HELD).problem, EXACT).problem.variables["points"].ambient()
    chosen = solve(assemble(other.keep(points=[]), HELD).problem, EXACT).problem
    lines = chosen.variables["lines"].ambient()[world.landmarks[1]]
    d = lines[:, 3:] / np.linalg.norm(lines[:, 3:], axis=1, keepdims=True)
    foot = np.cross(d, lines[:, :3] / np.linalg.norm(lines[:, 3:], axis=1, keepdims=True))
    near = world.matches.segments3d
    places = foot[:, None] + np.einsum("nki,ni->nk", near - foot[:, None], d)[..., None] * d[:, None]
    return replace(world.matches, points3d=xyz[world.landmarks[0]], segments3d=places)


@pytest.mark.kernels
def test_maps_whose_poses_nothing_contradicts_or_that_are_too_large_have_none():
    world = _map(1)
    bare = world.scene.keep(points=[], lines=[])
    assert common_errors(bare, bare, (1.0, 1.0), (False, False))[0] is None
    assert world.errors(gates=replace(GATES, unknowns=6 * world.scene.num_frames)) is None


@pytest.mark.kernels
def test_exact_calibrations_leave_errors_of_poses():
    world = _map(2)
    posed, _ = common_errors(world.scene, world.scene, (1.0, 1.0), (True, False))
    both = world.errors()
    assert posed is not None and both is not None
    assert posed.parameters == 0 and both.parameters == 4
    found = refine(world.camera, world.matches, world.start(), max_errors(world.matches), gathered=True)
    less, more = (one.of_query(found, world.landmarks) for one in (posed, both))
    assert 0.0 < np.trace(less) < np.trace(more)


@pytest.mark.kernels
def test_two_images_are_enough():
    """Two centres leave the rotation about the line through them free: the rotations of the poses settle it. What is
    left is the motion between the two but for its length.
    """
    world = _map(0, num_images=3)
    found, _ = common_errors(world.scene, world.scene, (1.0, 1.0), (True, False))
    assert found is not None
    extent = np.linalg.norm(np.diff(world.scene.cam_centers_in_world, axis=0))
    size = np.tile([1.0, 1.0, 1.0, extent, extent, extent], 2)
    values = np.linalg.eigvalsh(found.covariance * np.outer(size, size))
    assert values[6] < 1e-6 * values[7] and values[7] > 0.0
