# SPDX-License-Identifier: BSD-3-Clause
"""Principal points of cameras whose calibration was not given: estimated where observations tell them."""

import numpy as np
import pytest

import groma
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.misfit.jackknife import landmark_jackknife, observations_alone
from groma.adjustment.terms.principal_points import GATES, near_the_middle
from groma.adjustment.uncertainty import pose_uncertainty
from groma.cameras import model as camera_model
from groma.geometry import se3
from groma.scene import Cameras, PointObservations, Points, PrincipalPointPriors, Scene
from groma.scene.synthetic import holistic
from groma.solver.covariance.marginals import Covariances

NOISE, WIDTH, HEIGHT = 0.5, 1024, 768
UNKNOWN = AssemblyOptions(refine_intrinsics=None, refine_principal_point=None, point_sigma_px=NOISE)
LEAST_SQUARES = {"loss": "none", "point_sigma_px": NOISE, "check_lens": False, "function_tolerance": 1e-10}


def _seen(poses, xyz, lens, rng):
    """What one camera of a lens sees of points, with noise; and the same as it is begun with."""
    cameras = Cameras([1], ("SIMPLE_RADIAL",), lens[None], [WIDTH], [HEIGHT])
    image, point, pixel = [], [], []
    for row, pose in enumerate(poses):
        in_camera = se3.transform_points(np.repeat(pose[None], len(xyz), axis=0), xyz)
        seen = camera_model("SIMPLE_RADIAL").project(lens, in_camera)
        inside = np.isfinite(seen).all(1) & (seen > 1.0).all(1) & (seen < (WIDTH - 1, HEIGHT - 1)).all(1)
        rows = np.flatnonzero(inside & (in_camera[:, 2] > 0.3) & (rng.random(len(xyz)) < 0.5))
        image.append(np.full(len(rows), row)), point.append(rows), pixel.append(seen[rows])
    image, point, pixel = (np.concatenate(part) for part in (image, point, pixel))
    pixel = pixel + rng.normal(0.0, NOISE, pixel.shape)
    truth = Scene.from_images(
        cameras, [f"{row}.png" for row in range(len(poses))], np.zeros(len(poses), int), poses,
        points=Points.at(xyz), point_observations=PointObservations.numbered(image, point, pixel),
    )  # fmt: skip
    truth = truth.keep(points=np.bincount(point, minlength=len(xyz)) > 1)
    return truth, near_the_middle(truth.with_params([[lens[0], WIDTH / 2, HEIGHT / 2, lens[3]]]))


def _around(seed):
    """Cameras all around, whose lens is as far from the middle as lenses are."""
    rng, made = np.random.default_rng(seed), holistic(10, seed, noise_px=0.0).truth
    off = rng.normal(0.0, GATES.centred * WIDTH, 2)
    lens = np.array([rng.uniform(700, 1000), WIDTH / 2 + off[0], HEIGHT / 2 + off[1], rng.normal(0.0, 0.05)])
    return *_seen(made.cam_from_world, made.points.xyz, lens, rng), lens


def _one_direction(seed, depth=1.5):
    """Cameras that look at a rough wall in one direction."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform((-2, -1, -6.2), (2, 1, -5.8), (6, 3))
    xyz = np.column_stack([rng.uniform(-3, 3, (120, 2)), rng.uniform(-depth, depth, 120)])
    lens = np.array([800.0, WIDTH / 2 + 12.0, HEIGHT / 2 - 9.0, 0.0])
    return *_seen(np.hstack([np.tile([0, 0, 0, 1.0], (6, 1)), -centers]), xyz, lens, rng), lens


def _in_deviations(found, truth):
    """Squared errors of the cameras over their variances, after the alignment of the frames."""
    covariances = Covariances(found.problem, gauge="inner")
    frames = found.problem.variables["frames"]
    errors = {name: np.zeros((len(one), one.manifold.dof)) for name, one in found.problem.variables.items()}
    errors["frames"] = frames.manifold.local(frames.state, truth.frames.rig_from_world)
    e = covariances.in_datum(errors)["frames"]
    return np.einsum("ni,ni->n", e, np.linalg.solve(covariances.of("frames"), e[..., None])[..., 0]) / 6.0


def test_they_are_expected_in_the_middle_of_cameras_that_have_one():
    size = [WIDTH, WIDTH, 0], [HEIGHT, HEIGHT, 0]
    params = np.zeros((3, 4))
    params[0], params[1, :2], params[2] = (800, 512, 384, 0), (WIDTH, HEIGHT), (800, 0, 0, 0)
    scene = near_the_middle(
        Scene(cameras=Cameras([1, 2, 3], ("SIMPLE_RADIAL", "EQUIRECTANGULAR", "SIMPLE_RADIAL"), params, *size))
    )
    table = scene.principal_point_priors
    assert table.camera_idx.tolist() == [0]
    assert table.pixel.tolist() == [[512.0, 384.0]]
    assert table.sigma == pytest.approx([GATES.centred * WIDTH])


def test_only_cameras_that_see_are_estimated():
    _, start, _ = _around(0)
    cameras = start.cameras
    two = Cameras(
        [1, 2], cameras.models * 2, np.repeat(cameras.params, 2, axis=0), *([side] * 2 for side in (WIDTH, HEIGHT))
    )
    problem = assemble(near_the_middle(start.replace(cameras=two)), UNKNOWN).problem
    group = problem.variables["intrinsics/SIMPLE_RADIAL"]
    assert group.free_coordinates().tolist() == [[True] * 4, [False] * 4]
    prior = next(factor for factor in problem.factors if factor.type_name == "vector_prior")
    assert prior.variable.index.tolist() == [0]
    assert (
        len(groma.adjust(start.replace(cameras=two), groma.AdjustOptions(**LEAST_SQUARES)).report.num_measurements) == 0
    )


@pytest.mark.kernels
def test_what_is_not_asked_for_stays():
    """Held, a scene with the table is the same problem as one without; and a given calibration is held."""
    _, start, _ = _around(1)
    held = [
        groma.adjust(one, groma.AdjustOptions(refine_intrinsics=refine, **LEAST_SQUARES)).scene
        for one, refine in ((start, False), (start.replace(principal_point_priors=PrincipalPointPriors()), None))
    ]
    np.testing.assert_array_equal(held[0].points.xyz, held[1].points.xyz)
    np.testing.assert_array_equal(held[0].cameras.params, start.cameras.params)
    told = groma.AdjustOptions(refine_intrinsics=True, refine_principal_point=False, **LEAST_SQUARES)
    np.testing.assert_array_equal(groma.adjust(start, told).scene.cameras.params[0, 1:3], start.cameras.params[0, 1:3])


@pytest.mark.kernels
@pytest.mark.compiled
def test_they_are_found_where_cameras_look_in_many_directions():
    for seed in range(3):
        _, start, lens = _around(seed)
        held = groma.adjust(
            start, groma.AdjustOptions(refine_intrinsics=True, refine_principal_point=False, **LEAST_SQUARES)
        )
        found = groma.adjust(held.scene, groma.AdjustOptions(**LEAST_SQUARES))
        assert found.scene.cameras.params[0, 1:3] == pytest.approx(lens[1:3], abs=2.5)
        assert abs(found.scene.cameras.params[0, 0] / lens[0] - 1.0) < 0.003
        assert pose_uncertainty(found.scene, found.problem)["calibration"] == "none"
        assert pose_uncertainty(held.scene, held.problem)["calibration"] == "part"


@pytest.mark.kernels
@pytest.mark.compiled
def test_deviations_hold_the_errors_of_an_estimated_calibration():
    """Over draws of lenses: squared errors are as large as stated; with the middle held they are many times that."""
    ratios = []
    for seed in range(8):
        truth, start, _ = _around(100 + seed)
        found = groma.adjust(start, groma.AdjustOptions(**LEAST_SQUARES))
        held = groma.adjust(start, groma.AdjustOptions(refine_intrinsics=False, **LEAST_SQUARES))
        ratios.append([_in_deviations(one, truth).mean() for one in (found, held)])
    free, held = np.mean(ratios, axis=0)
    # 480 squares, of which the six of one camera and those of neighbours go together: 0.1 of deviation at most
    assert free == pytest.approx(1.0, abs=0.3)
    assert held > 20.0


@pytest.mark.kernels
@pytest.mark.compiled
def test_one_direction_of_view_leaves_them_where_they_are_expected():
    for seed in range(4):
        _, start, lens = _one_direction(seed)
        found = groma.adjust(start, groma.AdjustOptions(**LEAST_SQUARES))
        sigma = GATES.centred * WIDTH
        known = Covariances(found.problem, gauge="inner").of("intrinsics/SIMPLE_RADIAL")[0]
        deviation = np.sqrt(np.diag(known))[1:3]
        assert (deviation < 1.001 * sigma).all() and (deviation > 0.2 * sigma).all()
        off = found.scene.cameras.params[0, 1:3] - lens[1:3]
        assert (np.abs(off) < 4.0 * deviation).all()
        held = groma.adjust(start, groma.AdjustOptions(refine_intrinsics=False, **LEAST_SQUARES))
        turn = [pose_uncertainty(one.scene, one.problem)["rotation_deg"]["median"] for one in (found, held)]
        assert turn[0] > 3.0 * turn[1]


@pytest.mark.kernels
@pytest.mark.compiled
def test_what_is_known_of_lenses_does_not_grow_with_the_noise():
    _, start, _ = _one_direction(5)
    found = groma.adjust(start, groma.AdjustOptions(**LEAST_SQUARES))
    covariances = Covariances(found.problem, gauge="inner", datum={"frames": [1, 1, 1, 0, 0, 0]})
    stated = np.sqrt(np.trace(covariances.of("frames")[:, 3:, 3:], axis1=1, axis2=2))
    told = [pose_uncertainty(found.scene, found.problem, sigma0)["rotation_deg"]["median"] for sigma0 in (1.0, 0.01)]
    assert told[0] == pytest.approx(np.rad2deg(np.median(stated)))
    assert 0.01 * told[0] < told[1] < 0.5 * told[0]  # the data then tell the principal point
    small = groma.adjust(start, groma.AdjustOptions(**LEAST_SQUARES | {"point_sigma_px": 0.01 * NOISE}))
    exact = pose_uncertainty(small.scene, small.problem)["rotation_deg"]["median"]
    assert told[1] == pytest.approx(exact, rel=0.2)  # elsewhere, as the prior pulls less


@pytest.mark.kernels
@pytest.mark.compiled
def test_leaving_out_landmarks_keeps_what_is_known_without_them():
    _, start, _ = _one_direction(9)
    found = groma.adjust(start, groma.AdjustOptions(**LEAST_SQUARES))
    covariances = Covariances(observations_alone(found.problem), gauge="inner")
    stated, by_landmarks = landmark_jackknife(covariances)
    ratio = np.sqrt(np.trace(by_landmarks[:, 3:, 3:], axis1=1, axis2=2) / np.trace(stated[:, 3:, 3:], axis1=1, axis2=2))
    # The prior decides, whose size landmarks do not tell: by these alone it would be a third.
    assert ratio == pytest.approx(1.0, abs=0.25)


def test_a_camera_is_expected_once():
    with pytest.raises(groma.InputError, match="must be unique"):
        PrincipalPointPriors([0, 0], np.zeros((2, 2)), np.ones(2))


@pytest.mark.kernels
def test_a_middle_that_nobody_measured_is_a_guess():
    _, start, lens = _around(2)
    bare = start.replace(principal_point_priors=PrincipalPointPriors())
    found = groma.adjust(bare, groma.AdjustOptions(refine_intrinsics=True, **LEAST_SQUARES)).scene
    assert found.principal_point_priors.camera_idx.tolist() == [0]
    assert found.cameras.params[0, 1:3] == pytest.approx(lens[1:3], abs=2.5)
    measured = bare.with_params(np.add(bare.cameras.params, [[0.0, 1.5, 0.0, 0.0]]))
    found = groma.adjust(measured, groma.AdjustOptions(refine_intrinsics=True, **LEAST_SQUARES)).scene
    np.testing.assert_array_equal(found.cameras.params[0, 1:3], measured.cameras.params[0, 1:3])
    assert len(found.principal_point_priors) == 0
