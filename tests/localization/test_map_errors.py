# SPDX-License-Identifier: BSD-3-Clause
"""Errors of a map beside the noise of its landmarks: what they are, and that poses in the map know of them."""

from dataclasses import replace

import numpy as np

from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.stages import with_loss
from groma.factors.losses import GemanMcClure
from groma.geometry import se3
from groma.localization.errors.left_out import without_image
from groma.localization.errors.map_errors import SeenByImage, images_compared, shared_errors
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.hypotheses import max_errors
from groma.localization.pose.matches import Matches
from groma.localization.pose.records import landmark_covariances, motions_of_lines
from groma.localization.pose.refinement import refine
from groma.scene.synthetic import holistic
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

NOISE = 0.5
HELD = AssemblyOptions(refine_poses=False, point_chart="euclidean", gauge="free")


def _estimated(scene, kind):
    """Landmarks of one kind from the poses of a scene as they are, with covariances; NaN where not determined."""
    other = {"points": "lines", "lines": "points"}[kind]
    alone = scene.keep(**{other: []}, planes=[], directions=[])
    problem = with_loss(assemble(alone, HELD).problem, GemanMcClure(3.0))
    problem = solve(problem, SolverOptions(max_iterations=100, function_tolerance=1e-14)).problem
    count = len(getattr(scene, kind))
    return problem.variables[kind].ambient()[:count], landmark_covariances(problem, kind, count)


def _places(plucker, near):
    """Places (n, 2, 3) on lines, the nearest to others."""
    d = plucker[:, 3:] / np.linalg.norm(plucker[:, 3:], axis=1, keepdims=True)
    foot = np.cross(d, plucker[:, :3] / np.linalg.norm(plucker[:, 3:], axis=1, keepdims=True))
    return foot[:, None] + np.einsum("nki,ni->nk", near - foot[:, None], d)[..., None] * d[:, None]


class _Map:
    """A scene with noisy pixels whose landmarks are estimated from its images, whose poses may be off."""

    def __init__(self, seed, turn=0.0, num_images=15, queries=(), noise=NOISE):
        rng = np.random.default_rng(seed)
        self.truth = holistic(num_images, seed, noise_px=0.0).truth
        points, lines = self.truth.point_observations, self.truth.line_observations
        ends = lines.segment.reshape(-1, 2, 2)
        way = ends[:, 1] - ends[:, 0]
        across = np.column_stack([-way[:, 1], way[:, 0]]) / np.linalg.norm(way, axis=1, keepdims=True)
        ends = ends + rng.normal(0.0, noise, (*ends.shape[:2], 1)) * across[:, None]
        self.scene = self.truth.replace(
            point_observations=points.replace(
                pixel=points.pixel + rng.normal(0.0, noise, points.pixel.shape), sigma=np.full(len(points), NOISE)
            ),
            line_observations=lines.replace(segment=ends.reshape(-1, 4), sigma=np.full(len(lines), NOISE)),
        )
        self.poses = se3.compose(
            se3.exp(rng.normal(0.0, turn, (num_images, 6)) * [0, 0, 0, 1, 1, 1]), self.truth.cam_from_world
        )
        self.mapped = np.setdiff1d(np.arange(num_images), queries)
        self.of_map = _seen_by(self.scene.with_poses(self.poses), self.mapped)
        self.xyz, self.point_covariance = _estimated(self.of_map, "points")
        self.plucker, self.line_covariance = _estimated(self.of_map, "lines")

    def matches(self, image, shared_error=0.0):
        """What an image sees of the landmarks that the map has."""
        points, lines = self.scene.point_observations, self.scene.line_observations
        rows, segments = np.flatnonzero(points.image_idx == image), np.flatnonzero(lines.image_idx == image)
        point, line = points.point_idx[rows], lines.line_idx[segments]
        rows, point = (one[np.isfinite(self.point_covariance[point, 0, 0])] for one in (rows, point))
        known = np.isfinite(self.line_covariance[line, 0, 0])
        segments, line = segments[known], line[known]
        return Matches(
            points.pixel[rows], self.xyz[point], lines.segment[segments].reshape(-1, 2, 2),
            _places(self.plucker[line], self.truth.lines.segments[line]), points.sigma[rows], lines.sigma[segments],
            self.point_covariance[point], self.line_covariance[line], shared_error=shared_error,
        )  # fmt: skip

    def camera(self, image):
        return QueryCamera.of(self.scene.cameras, int(self.scene.images.camera_idx[image]))

    def seen(self):
        return [SeenByImage(self.camera(i), self.matches(i), self.poses[i]) for i in self.mapped.tolist()]

    def normalised(self, image, shared_error):
        """Squared error of the pose of a query in units of its covariance."""
        matches = self.matches(image, shared_error)
        found = refine(self.camera(image), matches, self.truth.cam_from_world[image], max_errors(matches))
        error = se3.log(se3.compose(self.truth.cam_from_world[image][None], se3.inverse(found.pose[None])))[0]
        return error @ np.linalg.solve(found.covariance(matches), error)


def _seen_by(scene, images):
    """A scene with the observations of some of its images alone; all landmarks stay."""
    tables = {name: getattr(scene, name) for name in ("point_observations", "line_observations")}
    return scene.replace(**{name: one.take(np.isin(one.image_idx, images)) for name, one in tables.items()})


def test_an_image_is_taken_out_of_its_points():
    """As if they had been estimated without it, by another solve; of lines likewise.

    Noise is far less than stated, so that the loss of the solve has no part in it.
    """
    world, image = _Map(3, noise=0.02), 4
    others = _seen_by(world.of_map, np.delete(np.arange(15), image))
    every = world.matches(image)
    left = without_image(world.camera(image), every, world.poses[image])
    for kind, before, after, spread in (
        ("points", every.points3d, left.points3d, left.point_covariance),
        ("lines", every.segments3d, left.segments3d, left.line_covariance),
    ):
        table = getattr(world.scene, f"{kind[:-1]}_observations")
        index = getattr(table, f"{kind[:-1]}_idx")[table.image_idx == image]
        state, covariance = _estimated(others, kind)
        true, known = covariance[index], np.isfinite(covariance[index, 0, 0])
        assert len(after) == known.sum() > 5
        size = np.trace(true[known], axis1=1, axis2=2)
        assert np.median(np.abs(np.trace(spread, axis1=1, axis2=2) / size - 1.0)) < 0.05
        expected = state[index][known]
        if kind == "lines":
            expected = _places(expected, after)
        # A step is many times larger than what it leaves to the other solve.
        step, rest = (np.linalg.norm(one - after, axis=-1).mean() for one in (before[known], expected))
        assert rest < 0.1 * step, (kind, rest, step)


def test_lines_that_are_hardly_determined_are_left_out():
    """Their information is at the limit of rounding, where its sign is chance; points stay as they are."""
    world, image = _Map(3), 4
    every = world.matches(image)
    one, two = np.moveaxis(every.segments3d, 1, 0)
    way = (two - one) / np.linalg.norm(two - one, axis=1, keepdims=True)
    free = motions_of_lines(np.concatenate([np.cross(one, way), way], axis=1))
    hardly = np.einsum("nij,nj->ni", free, np.random.default_rng(0).normal(size=(len(free), 4)))
    wide = every.line_covariance + 1e15 * every.line_covariance.max() * hardly[:, :, None] * hardly[:, None]
    left = without_image(world.camera(image), replace(every, line_covariance=wide), world.poses[image])
    expected = without_image(world.camera(image), every, world.poses[image])
    assert every.num_lines > 5 and left.num_lines == 0
    np.testing.assert_array_equal(left.points3d, expected.points3d)


def _queries(turn):
    """What maps are told to be off by, and squared errors of queries in units of covariances with and without that."""
    told, knowing, plain = [], [], []
    for seed in (1, 2, 3, 4):
        queries = (2, 7, 12, 17)
        world = _Map(seed, turn, 20, queries)
        told.append(shared_errors(world.seen()))
        knowing += [world.normalised(image, float(told[-1][1])) for image in queries]
        plain += [world.normalised(image, 0.0) for image in queries]
    return np.mean(told, axis=0), np.mean(knowing) / 6.0, np.mean(plain) / 6.0


def test_queries_know_of_wrong_poses_in_the_map():
    """Each pose of the map is off by itself, by 3 mrad about each axis: queries are better than that, as the landmarks
    average it, but no worse than they are told.
    """
    told, knowing, plain = _queries(turn=3e-3)
    assert plain > 4.0
    assert 0.05 < knowing < 1.4, (told, knowing, plain)


def test_a_map_without_errors_is_told_to_have_none():
    told, knowing, plain = _queries(0.0)
    assert 0.6 < plain < 1.4  # 16 queries of six degrees: 1 with a standard deviation of 0.14
    assert 0.5 < knowing < 1.4, (told, knowing, plain)
    assert told.max() < 5e-4


def test_too_few_images_tell_nothing():
    world = _Map(5, 3e-3)
    assert shared_errors(world.seen()[:2]).tolist() == [0.0, 0.0]


def test_images_are_chosen_evenly():
    assert images_compared(5).tolist() == [0, 1, 2, 3, 4]
    chosen = images_compared(1000)
    assert len(chosen) == 32 and chosen[0] == 0 and chosen[-1] == 999
