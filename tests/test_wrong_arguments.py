# SPDX-License-Identifier: BSD-3-Clause
"""What callers pass by mistake: a path or a result in place of a scene, what is no array of numbers. One sentence says
which argument it was, what came, and how to get what is wanted.
"""

from types import SimpleNamespace

import numpy as np
import pytest

import groma
from groma import features, io
from groma.adjustment.assemble import AssemblyOptions, assemble, disassemble
from groma.errors import InputError
from groma.evaluation import align_poses, score_poses
from groma.geometry import line3, plane3, quaternion, se3, sim3
from groma.mapping.lines.build import map_lines
from groma.mapping.structure.find import find_structure
from groma.problem.residuals import jacobians_of, residuals_of
from groma.scene.synthetic import corridor, holistic
from groma.solver.covariance.marginals import Covariances
from groma.solver.covariance.quantities import angle_between_planes

SCENE = holistic(2, seed=0).start
CAMERA = groma.QueryCamera("SIMPLE_PINHOLE", np.array([500.0, 320.0, 240.0]), 640, 480)
COVARIANCES = Covariances(assemble(SCENE, AssemblyOptions()).problem)
PIXELS, PLACES = np.zeros((4, 2)), np.ones((4, 3))
TAKE_SCENES = {
    "adjust": groma.adjust,
    "adjust_surveyed": groma.adjust_surveyed,
    "assemble": lambda scene: assemble(scene, AssemblyOptions()),
    "align": lambda scene: groma.align(scene, SCENE),
    "align to": lambda scene: groma.align(SCENE, scene),
    "contributions": groma.contributions,
    "diagnose": groma.diagnose,
    "evaluate_lines": lambda scene: groma.evaluate_lines(scene, SCENE),
    "evaluate_lines with": lambda scene: groma.evaluate_lines(SCENE, scene),
    "evaluate_planes": lambda scene: groma.evaluate_planes(scene, SCENE),
    "evaluate_poses": lambda scene: groma.evaluate_poses(SCENE, scene),
    "find_structure": find_structure,
    "map_images": lambda scene: groma.map_images("photographs", "work", scene),
    "map_lines": lambda scene: map_lines(scene, []),
    "reliability": groma.reliability,
    "uncertainty": groma.uncertainty,
    "write_parts": lambda scene: groma.write_parts(scene, "parts"),
    "write_report": lambda scene: groma.write_report("page.html", None, scene),
    "write_scene": lambda scene: groma.write_scene(scene, "a.npz"),
    **{
        writer.__name__: lambda scene, writer=writer: writer(scene, "a")
        for writer in (
            io.write_archive, io.write_bal, io.write_colmap, io.write_dxf, io.write_gltf, io.write_obj, io.write_ply,
            io.write_recording, io.write_transforms, io.to_pycolmap,
        )
    },
}  # fmt: skip


@pytest.mark.parametrize("function", TAKE_SCENES.values(), ids=TAKE_SCENES)
def test_a_path_or_a_result_is_no_scene(function, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"must be a Scene.*; got str\. Read one with groma\.read_scene\(path\)"):
        function("model")
    with pytest.raises(InputError, match=r"must be a Scene.*; got SimpleNamespace\. .*pass its \.scene\.$"):
        function(SimpleNamespace(scene=SCENE))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (lambda: groma.solve(SCENE), "problem must be a Problem; got Scene"),  # type: ignore[arg-type]
        (lambda: groma.adjust_pose_graph("a.g2o"), r"graph must be a PoseGraph; got str.*read_g2o"),  # type: ignore[arg-type]
        (lambda: groma.evaluate_trajectory("a.txt", "b.txt"), "estimate must be a Trajectory; got str"),  # type: ignore[arg-type]
        (lambda: groma.estimate_motion(np.zeros((4, 6))), "matches must be a LandmarkMatches; got ndarray"),  # type: ignore[arg-type]
        (lambda: groma.estimate_absolute_pose("abc"), r"camera must be a QueryCamera; got str\. Make one"),  # type: ignore[arg-type]
        (lambda: groma.Localizer(SCENE, options={}), "options must be a LocalizeOptions; got dict"),  # type: ignore[arg-type]
        (lambda: groma.Tracker(CAMERA), "camera must be a SequenceCamera; got QueryCamera"),  # type: ignore[arg-type]
        (lambda: groma.track(3), "sequence must be a Sequence; got int"),  # type: ignore[arg-type]
        (lambda: groma.loss(None), "name must be a str; got NoneType"),  # type: ignore[arg-type]
        (lambda: groma.Problem([], []), "variables must be a Mapping; got list"),  # type: ignore[arg-type]
        (lambda: groma.Variables(None, PLACES), "manifold must be a Manifold; got NoneType"),  # type: ignore[arg-type]
        (lambda: groma.adjust(SCENE, {"loss": "huber"}), "options must be an AdjustOptions; got dict.*leave it out"),  # type: ignore[arg-type]
        (lambda: groma.adjust_surveyed(SCENE, options={}), "options must be an AdjustOptions; got dict"),  # type: ignore[arg-type]
        (lambda: groma.uncertainty(SCENE, groma.AdjustOptions()), "must be an AssemblyOptions; got AdjustOptions"),  # type: ignore[arg-type]
        (lambda: groma.diagnose(SCENE, groma.AdjustOptions()), "must be an AssemblyOptions; got AdjustOptions"),  # type: ignore[arg-type]
        (lambda: map_lines(SCENE, SCENE), "segments must be a Sequence; got Scene"),  # type: ignore[arg-type]
        (lambda: groma.adjust_parts("part.npz", "out"), r"parts must be a list or tuple; got str\. Pass the paths"),
        (lambda: align_poses("a.txt", "b.txt"), "source must be an array of real numbers; got str"),
        (lambda: score_poses({}, {}), "estimated must be an array of real numbers; got dict"),  # type: ignore[arg-type]
        (lambda: groma.cameras.model(1), "name must be a str; got int"),  # type: ignore[arg-type]
        (lambda: holistic(4, noise_px=float("nan")), "noise_px must be a standard deviation, 0 or more; got nan"),
        (lambda: holistic(4, structure=-1.0), "structure must be a standard deviation, 0 or more; got -1"),
        (lambda: holistic("four"), "num_images must be an int or integer; got str"),  # type: ignore[arg-type]
        (lambda: corridor(None), "size must be an int or integer; got NoneType.*or one of"),  # type: ignore[arg-type]
        (lambda: disassemble(SCENE, SCENE), "problem must be a Problem; got Scene"),  # type: ignore[arg-type]
        (lambda: Covariances(SCENE), "problem must be a Problem; got Scene"),  # type: ignore[arg-type]
        (lambda: angle_between_planes(SCENE, ("planes", 0), ("planes", 1)), "covariances must be a Covariances"),  # type: ignore[arg-type]
        (lambda: angle_between_planes(COVARIANCES, 0, 1), r"A variable must be a tuple; got int\. Pass \(group"),  # type: ignore[arg-type]
        (lambda: residuals_of(SCENE, {}), "factor must be a Factor; got Scene"),  # type: ignore[arg-type]
        (lambda: jacobians_of("a", {}), "factor must be a Factor; got str"),  # type: ignore[arg-type]
        (lambda: groma.QueryCamera.of(SCENE, 0), r"table must be a Cameras; got Scene\. Pass scene\.cameras"),  # type: ignore[arg-type]
        (lambda: groma.cameras.in_model(np.ones(4), "PINHOLE", "OPENCV"), "old must be a CameraModel; got str"),  # type: ignore[arg-type]
        (lambda: groma.cameras.register_camera("MINE", None, None, None), "camera must be a CameraModel; got str"),  # type: ignore[arg-type]
        (lambda: io.register_format("ply"), "scene_format must be a SceneFormat; got str"),  # type: ignore[arg-type]
        (lambda: io.sequences.register_layout("folder"), "layout must be a SequenceLayout; got str"),  # type: ignore[arg-type]
        (lambda: features.nearby_points(PIXELS, PIXELS, np.arange(4)), "segments must be a Segments; got ndarray"),  # type: ignore[arg-type]
        (lambda: features.match_wide_baseline(SCENE, SCENE, PIXELS, PIXELS), "segments_1 must be a Segments; got Sc"),  # type: ignore[arg-type]
        (lambda: features.fundamental_from_poses(*[np.eye(3)] * 4), r"cam1_from_world must have shape \(..., 3, 4\)"),
        (lambda: features.write_matches("a.npz", {}), "external must be an ExternalMatches; got dict"),  # type: ignore[arg-type]
        (lambda: corridor(12, noise_px=float("inf")), "noise_px must be a standard deviation, 0 or more; got inf"),
    ],
)
def test_other_kinds_are_named(function, words):
    with pytest.raises(InputError, match=words):
        function()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"points2d": "abc"}, "points2d must be an array of real numbers; got str"),
        ({"points3d": None}, r"points3d must have shape \(4, 3\), one row a match; got \(0, 3\)"),
        ({"points3d": PLACES * np.nan}, "points3d must be finite"),
        ({"sigma": 2.0}, r"\[sigma\] must have shape \(N, 2\)"),
        ({"sigma": (0.0, 1.0)}, "point_sigma must be positive"),
        ({"covariances": None}, r"covariances must be a tuple or list; got NoneType\. Pass \(of points, of lines\)"),
        ({"covariances": ("abc", None)}, "covariances must be an array of real numbers"),
        ({"covariances": (np.eye(3), None)}, r"point_covariance must have shape \(4, 3, 3\)"),
        ({"covariances": (np.tile(-np.eye(3), (4, 1, 1)), None)}, "of points must be symmetric positive semidefinite"),
        ({"covariances": (np.tile(np.tri(3), (4, 1, 1)), None)}, "of points must be symmetric positive semidefinite"),
    ],
)
def test_matches_of_a_pose_that_are_none(given, words):
    with pytest.raises(InputError, match=words):
        groma.estimate_absolute_pose(CAMERA, **({"points2d": PIXELS, "points3d": PLACES} | given))


def test_covariances_may_be_singular():
    """What is exact along one axis has a covariance without inverse, and rounding may leave it slightly negative."""
    flat = np.tile(np.diag([1e-4, 1e-4, -1e-24]), (4, 1, 1))
    assert groma.estimate_absolute_pose(CAMERA, PIXELS, PLACES, covariances=(flat, None)).status == "failed"


@pytest.mark.parametrize(
    "function",
    [
        line3.moment,
        plane3.canonical,
        se3.inverse,
        se3.from_matrix,
        sim3.inverse,
        sim3.from_matrix,
        quaternion.conjugate,
    ],
)
@pytest.mark.parametrize("value", ["abc", [[1.0, 2.0], [3.0]], {}, np.ones((4, 8)) * 1j], ids=str)
def test_what_is_no_array_of_numbers_is_refused(function, value):
    with pytest.raises(InputError, match=r"\w+ must be an array of real numbers; got (str|list|dict|ndarray) \("):
        function(value)
