# SPDX-License-Identifier: BSD-3-Clause
"""Fits of one pose end where a robust cost is least, with and without what is free of a lens; a wrong lens is told."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import CAMERA, make_world, project

from groma.adjustment.terms.principal_points import GATES as PRINCIPAL_POINTS
from groma.factors.losses import Cauchy, GemanMcClure
from groma.geometry import se3
from groma.localization.candidates import closest_of
from groma.localization.pose.absolute_pose import MapQuestions, PoseOptions, estimate_absolute_pose, pose_from_matches
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.free_lens import free_lens
from groma.localization.pose.gates import REFINEMENT, VERDICT
from groma.localization.pose.hypotheses import max_errors
from groma.localization.pose.lens import LensStep, lens_step
from groma.localization.pose.matches import Matches
from groma.localization.pose.pose_fit import fit_pose
from groma.localization.pose.pose_problem import problem_of
from groma.localization.pose.refinement import refine, weighed
from groma.localization.pose.verdict import Verdict, doubted_if_other_lens
from groma.solver.options import SolverOptions

#: Ends where a step gains nothing in double precision.
TO_THE_END = SolverOptions(function_tolerance=1e-15, max_iterations=100)


def scaled(factor, camera=CAMERA):
    params = camera.params.copy()
    params[:2] *= factor
    return QueryCamera(camera.model, params, camera.width, camera.height)


def shifted(shift, camera=CAMERA):
    """The same with another principal point, in units of the mean focal length."""
    params = camera.params.copy()
    params[2:] += np.asarray(shift) * params[:2].mean()
    return QueryCamera(camera.model, params, camera.width, camera.height)


def noisy(rng, points, lines, sigma=0.7):
    world = make_world(rng, points, lines)
    world.points2d[:] += rng.normal(0.0, sigma, world.points2d.shape)
    world.segments2d[:] += rng.normal(0.0, sigma, world.segments2d.shape)
    return world, Matches(world.points2d, world.points3d, world.segments2d, world.segments3d).with_sigma(sigma)


def cost_of(matches, near, loss, pose, camera, sigma=0.7):
    """The cost, written down once more: pixels for points, distances of both ends for lines."""
    off = (project(camera, pose, matches.points3d) - matches.points2d) / sigma
    a, b = np.moveaxis(project(camera, pose, matches.segments3d), 1, 0)
    across = np.column_stack([b[:, 1] - a[:, 1], a[:, 0] - b[:, 0]]) / np.linalg.norm(b - a, axis=1, keepdims=True)
    ends = np.einsum("nki,ni->nk", matches.segments2d - a[:, None], across) / sigma
    squares = np.concatenate([(off**2).sum(axis=1)[near[0]], (ends**2).sum(axis=1)[near[1]]])
    return 0.5 * loss.evaluate(squares)[0].sum()


@pytest.mark.parametrize("loss", [Cauchy(1.5), GemanMcClure(1.9)])
@pytest.mark.parametrize(("which", "free"), [("none", 0), ("focal", 1), ("pinhole", 3)])
def test_the_cost_is_least_where_a_fit_ends(loss, which, free):
    """Central differences through the motions of pose and lens: the slope is zero, and every way is upwards."""
    rng = np.random.default_rng(3)
    for _ in range(3):
        world, matches = noisy(rng, 40, 15)
        near = rng.uniform(size=40) < 0.8, rng.uniform(size=15) < 0.8
        problem = problem_of(CAMERA, matches, world.pose)
        lens = free_lens(CAMERA, which)
        ended = fit_pose(problem, weighed(problem, matches)[0], near, loss, TO_THE_END, lens)
        pose = ended.pose
        camera = QueryCamera("PINHOLE", ended.params, 640, 480) if free else CAMERA
        least = cost_of(matches, near, loss, pose, camera)
        for k in range(6 + free):
            slopes, steps = [], (1e-4, 1e-3)
            for step in steps:
                costs = []
                for side in (-step, step):
                    twist = np.where(np.arange(6) == k, side, 0.0)
                    moved = se3.compose(se3.exp(twist[None]), pose[None])[0]
                    lens = scaled(np.exp(side), camera) if k == 6 else camera
                    lens = shifted(np.where(np.arange(2) == k - 7, side, 0.0), lens)
                    costs.append(cost_of(matches, near, loss, moved, lens))
                assert min(costs) > least
                slopes.append((costs[1] - costs[0]) / (costs[1] + costs[0] - 2.0 * least) * step)
            # The distance to the minimum of a parabola, twice: a third derivative is all that may be left.
            assert abs(slopes[0]) < 1e-5


def test_what_is_not_near_has_no_part():
    world, _ = noisy(np.random.default_rng(5), 60, 20)
    near = np.arange(60) < 40, np.arange(20) < 12
    found = []
    for shift in (0.0, 50.0):
        world.points2d[40:] += shift
        world.segments2d[12:] += shift
        moved = Matches(world.points2d, world.points3d, world.segments2d, world.segments3d).with_sigma(0.7)
        problem = problem_of(CAMERA, moved, world.pose)
        weights = weighed(problem, moved)[0]
        found.append(fit_pose(problem, weights, near, Cauchy(1.5), TO_THE_END).pose)
    assert found[0] == pytest.approx(found[1], abs=1e-10)


@pytest.mark.parametrize("factor", [0.8, 0.95, 1.05, 1.25])
def test_a_wrong_focal_length_is_found(factor):
    rng = np.random.default_rng(7)
    for _ in range(3):
        world, matches = noisy(rng, 150, 30)
        wrong = scaled(factor)
        best = refine(wrong, matches, world.pose, (50.0, 50.0))
        told = lens_step(best, matches, (50.0, 50.0))
        step, sigma = told.focal, told.focal_sigma
        assert sigma < 0.01
        assert step == pytest.approx(-np.log(factor), abs=5.0 * sigma)
        assert refine(wrong, matches, world.pose, (50.0, 50.0), free_lens(wrong, "focal")).camera.params[
            :2
        ] == pytest.approx(CAMERA.params[:2], rel=5.0 * sigma)


def test_the_stated_deviation_of_a_focal_length_is_true():
    rng = np.random.default_rng(11)
    squares = []
    for _ in range(100):
        world, matches = noisy(rng, 60, 10)
        best = refine(CAMERA, matches, world.pose, max_errors(matches))
        always = replace(VERDICT, focal=0.0, shift=0.0)  # the principal point is estimated, too
        told = lens_step(best, matches, max_errors(matches), gates=always)
        squares.append(((told.focal / told.focal_sigma) ** 2, told.square))
    of_focal, of_both = np.mean(squares, axis=0)
    # The sum is chi-square with 100 degrees: 0.999 of such are between 60 and 153. The variance is estimated besides.
    assert 0.6 < of_focal < 1.53
    # With 300 degrees: between 229 and 384.
    assert 2.29 < of_both < 3.84


def test_errors_of_the_map_count_in_what_is_told_of_a_lens():
    """A focal length that noise alone does not explain may be the one that was given, where the map is less certain."""
    world, matches = noisy(np.random.default_rng(5), 500, 50)
    wrong, variance, asked = scaled(1.03), 0.02**2, []

    def common(found, used, each):
        asked.append((used is matches, each))
        return np.diag(np.repeat([0.0, variance], [6, found.points.by_pose.shape[2] - 6]))

    best = refine(wrong, matches, world.pose, (50.0, 50.0))
    plain, told = (lens_step(best, matches, (50.0, 50.0), some) for some in (None, common))
    assert asked[0] == (True, 2)
    assert (told.focal, told.focal_sigma**2) == pytest.approx((plain.focal, plain.focal_sigma**2 + variance))
    right = Verdict("localized", 1.0, "")
    assert [doubted_if_other_lens(right, step).status for step in (plain, told)] == ["uncertain", "localized"]


def test_what_was_matched_without_a_pose_tells_its_lens():
    """Where things repeat, what is looked for near a pose with a wrong lens may all agree with both."""
    matches = noisy(np.random.default_rng(6), 150, 0)[1]
    for camera, status in ((CAMERA, "localized"), (scaled(1.02), "uncertain")):

        def guided(best, camera=camera):
            return replace(matches, points2d=project(camera, best.pose, matches.points3d))

        found = pose_from_matches(camera, matches, of_map=MapQuestions(guided))
        assert found.status == status
        assert ("shorter focal length" in found.sentence) == (status == "uncertain")


def test_few_matches_found_without_a_pose_tell_no_lens():
    step, right = LensStep(-0.04, 0.008), Verdict("localized", 1.0, "")
    assert doubted_if_other_lens(right, step, gathered=True).status == "uncertain"
    assert doubted_if_other_lens(right, step, gathered=True).other_focal
    assert not doubted_if_other_lens(right, LensStep(0.0, 0.002, 0.2, 100.0)).other_focal
    assert doubted_if_other_lens(right, step, gathered=False) is right
    assert doubted_if_other_lens(right, LensStep(-0.04, 0.002), gathered=False).status == "uncertain"


def test_a_piece_that_was_moved_is_told_from_its_lens():
    """What lies in one block of an image, moved as a whole, has its principal point moved by as much."""
    rng = np.random.default_rng(17)
    for _ in range(3):
        world, matches = noisy(rng, 400, 40)
        kept = (world.points2d[:, 0] > 300) & (world.points2d[:, 1] > 200)
        block = matches.take(kept, np.zeros(matches.num_lines, bool))
        for shift in (np.zeros(2), np.array([-0.4, -0.3])):
            moved = replace(block, points2d=block.points2d + shift * CAMERA.params[:2].mean())
            found = pose_from_matches(CAMERA, moved)
            assert found.cam_from_world is not None
            told = lens_step(refine(CAMERA, moved, found.cam_from_world, (50.0, 50.0)), moved, (50.0, 50.0))
            if shift.any():
                assert told.shift == pytest.approx(0.5, abs=0.2)
                assert (found.status, "principal point" in found.sentence) == ("uncertain", True)
            else:
                assert found.status == "localized"


def test_a_plane_seen_from_the_front_tells_no_focal_length():
    rng = np.random.default_rng(13)
    X = np.column_stack([rng.uniform(-2, 2, (100, 2)), np.full(100, 5.0)])
    pose = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    pixels = project(CAMERA, pose, X) + rng.normal(0.0, 0.7, (100, 2))
    matches = Matches(pixels, X).with_sigma(0.7)
    wrong = scaled(1.1)
    best = refine(wrong, matches, pose + 0.5 * np.eye(7)[6], max_errors(matches))
    told = lens_step(best, matches, max_errors(matches))
    step, sigma = told.focal, told.focal_sigma
    assert sigma > 0.05
    found = estimate_absolute_pose(wrong, pixels, X, sigma=(0.7, 1.0), options=PoseOptions(look_for_rival=False))
    assert abs(step) < 5.0 * sigma or found.status == "uncertain"


def test_the_most_alike_matches_are_counted():
    assert closest_of(np.array([0.1, 0.2, 0.3, 0.6]), np.array([0.4, 0.5, 0.7, 0.8])) == (2, 0)
    assert closest_of(np.array([0.4, 0.5]), np.array([0.1, 0.6])) == (0, 1)
    assert closest_of(np.zeros(0), np.zeros(0)) == (0, 0)


def unknown_lens(rng):
    """A lens that is drawn from the priors, and one in the middle with another focal length."""
    width, height = 640, 480
    off, shape = PRINCIPAL_POINTS.centred * width * rng.normal(size=2), np.exp(0.5 * REFINEMENT.square * rng.normal())
    true = [600.0 * shape, 600.0 / shape, 320.0 + off[0], 240.0 + off[1], -0.05, 0.0, 0.0, 0.0]
    start = np.array([620.0, 620.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0])
    return (QueryCamera("OPENCV", np.array(params), width, height) for params in (true, start))


def facade(rng, camera, count=250):
    """Points of a wall that is seen at an angle of 25 degrees, and what a camera sees of them with noise."""
    pixels = np.column_stack([rng.uniform(20, 620, count), rng.uniform(20, 460, count)])
    rays = camera.kind.unproject(camera.params, pixels)
    places = rays * (5.0 / (rays @ [np.sin(0.44), 0.0, np.cos(0.44)]))[:, None]
    return Matches(pixels + rng.normal(0.0, 0.5, pixels.shape), places).with_sigma(0.5)


def test_the_focal_length_before_a_facade_is_as_certain_as_is_told():
    """Centre and pixel shape are drawn from their priors: what they are off is in the deviation of the focal length.
    With both held it is far too small.
    """
    rng = np.random.default_rng(17)
    squares, centred = [], []
    for _ in range(40):
        true, start = unknown_lens(rng)
        matches = facade(rng, true)
        pose = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        lens = free_lens(start, "all")
        assert lens is not None
        held = replace(lens, center=lens.center[:0], expected=lens.expected[:0], shape=False)
        for found, free in ((squares, lens), (centred, held)):
            fit = refine(start, matches, pose, (50.0, 50.0), free)
            off = np.log(fit.camera.kind.focal_length(fit.camera.params) / true.kind.focal_length(true.params))
            found.append(off**2 / fit.joint_covariance(matches)[6, 6])
    # Chi-square with 40 degrees: 0.999 of such means are between 0.40 and 1.95.
    assert 0.4 < np.mean(squares) < 1.95
    assert np.mean(centred) > 3.0


def test_what_is_known_of_a_lens_is_differentiated_right():
    rng = np.random.default_rng(19)
    true, start = unknown_lens(rng)
    lens = free_lens(start, "all")
    assert lens is not None
    here, count = true.params, 5
    directions, products = lens.directions(here), lens.prior(here)
    assert directions.shape == (8, count)
    for k in range(count):
        sides = [lens.moved(here, np.where(np.arange(count) == k, side, 0.0)) for side in (-1e-5, 1e-5)]
        # Central differences of exponentials: a third derivative of some hundreds is left, and rounding.
        np.testing.assert_allclose((sides[1] - sides[0]) / 2e-5, directions[:, k], atol=1e-5)
        costs = [0.5 * lens.prior(side)[-1, -1] for side in sides]
        assert (costs[1] - costs[0]) / 2e-5 == pytest.approx(products[6 + k, -1], rel=1e-6, abs=1e-6)
