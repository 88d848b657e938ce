"""Measurements of other instruments and calibrations that were not given, in parts: the result is that of the whole."""

import numpy as np
import pytest
from _survey_objects import with_control

from groma.adjustment.assemble import assemble, disassemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.parts import adjust_parts, join_parts, write_parts
from groma.adjustment.survey.best_fit import best_fitted
from groma.adjustment.terms.camera_poses import held_scale
from groma.adjustment.terms.principal_points import near_the_middle
from groma.errors import InputError
from groma.geometry import line3, so3
from groma.scene import Similarity
from groma.scene.survey import CameraPositions, Distances, Kind, diagonal_covariance
from groma.scene.synthetic.scenes import holistic
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

pytestmark = [pytest.mark.kernels, pytest.mark.compiled]
GAUSS_NEWTON = SolverOptions(
    method="gauss_newton", linear_solver="dense", threads=1, max_iterations=20,
    function_tolerance=0.0, gradient_tolerance=0.0, step_tolerance=0.0,
)  # fmt: skip
SIZE = 150


def both(scene, folder, **options):
    """The scene adjusted in parts, and as a whole."""
    paths = write_parts(scene, folder / "parts", SIZE)
    assert len(paths) > 3
    result = adjust_parts(paths, folder / "out", options=GAUSS_NEWTON, **options)
    whole = best_fitted(join_parts(paths))
    how = AssemblyOptions(max_coupled_lines=0, **options)  # points are tied to lines in pixels, as in parts
    solution = solve(assemble(whole, how).problem, GAUSS_NEWTON)
    assert result.report.final_cost == pytest.approx(solution.report.final_cost, rel=1e-11)
    return join_parts(result.paths), best_fitted(disassemble(whole, solution.problem))


def compare(found, expected, *tables):
    """States to 1e-9 of their size."""
    for table, column in (("frames", "rig_from_world"), ("points", "xyz"), ("planes", "hesse"), *tables):
        mine, other = (getattr(getattr(one, table), column) for one in (found, expected))
        np.testing.assert_allclose(mine, other, rtol=0, atol=1e-9 * max(1.0, np.abs(other).max()))
    assert line3.distance_to_point(found.lines.plucker[:, None], expected.lines.segments).max() < 1e-8


@pytest.fixture
def positioned():
    """A scene with positions of its cameras, known to a tenth of its size, that starts elsewhere."""
    made = holistic(8, noise_px=0.5, rotation_deg=0.1, translation=0.005, structure=0.01)
    centers = made.truth.cam_centers_in_world
    rng, sigma = np.random.default_rng(0), 0.5
    noisy = centers + sigma * rng.normal(size=centers.shape)
    scene = made.start.transformed(Similarity(1.1, so3.exp(np.array([[0.1, 0.2, -0.1]]))[0], np.array([1.0, 2.0, 3.0])))
    covariance = diagonal_covariance(np.full(centers.shape, sigma))
    return scene.replace(camera_positions=CameraPositions(np.arange(len(centers)), noisy, covariance))


def test_scenes_are_placed_and_their_scale_is_held(positioned, tmp_path):
    assert held_scale(assemble(positioned, AssemblyOptions()).problem) is not None
    found, expected = both(positioned, tmp_path)
    compare(found, expected)
    off = best_fitted(found).cam_centers_in_world - found.cam_centers_in_world
    assert np.abs(off).max() < 1e-5


def test_expected_principal_points_are_estimated(positioned, tmp_path):
    """Where they are expected is in all parts, and counts once."""
    scene = near_the_middle(positioned)
    found, expected = both(scene, tmp_path, refine_intrinsics=None, refine_principal_point=None)
    compare(found, expected, ("cameras", "params"))
    moved = np.abs(found.cameras.params - scene.cameras.params)
    assert moved[:, 2:4].min() > 1e-3


def test_distances_between_control_points_and_lines(tmp_path):
    scene = with_control()
    xyz, line = scene.control_points.xyz, scene.lines.plucker[3]
    apart = float(np.linalg.norm(xyz[1] - xyz[0])) + 0.02
    away = float(line3.distance_to_point(line[None], xyz[2][None])[0]) + 0.02
    control, of_line = int(Kind.CONTROL_POINT), int(Kind.LINE)
    table = Distances(
        [control, control], [0, 2], [control, of_line], [1, 3], np.zeros((2, 3)), [apart, away], [0.005, 0.005]
    )
    found, expected = both(scene.replace(distances=table), tmp_path)
    compare(found, expected, ("control_points", "xyz"))
    assert np.abs(found.control_points.xyz - xyz).max() > 1e-3


def test_distances_between_lines_are_refused(tmp_path):
    scene = with_control()
    kind = int(Kind.LINE)
    table = Distances([kind], [0], [kind], [1], np.zeros((1, 3)), [1.0], [0.1])
    paths = write_parts(scene.replace(distances=table), tmp_path / "parts", SIZE)
    with pytest.raises(InputError, match="1 distance between lines"):
        adjust_parts(paths, tmp_path / "out")
