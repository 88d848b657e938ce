# SPDX-License-Identifier: BSD-3-Clause
"""What callers pass by mistake: a path or a result in place of a scene, what is no array of numbers. One sentence says
which argument it was, what came, and how to get what is wanted.
"""

from types import SimpleNamespace

import numpy as np
import pytest

import groma
from groma import io
from groma.errors import InputError
from groma.geometry import line3, plane3, quaternion, se3, sim3
from groma.scene.synthetic import corridor, holistic

SCENE = holistic(2, seed=0).start
TAKE_SCENES = {
    "adjust": groma.adjust,
    "adjust_surveyed": groma.adjust_surveyed,
    "align": lambda scene: groma.align(scene, SCENE),
    "align to": lambda scene: groma.align(SCENE, scene),
    "contributions": groma.contributions,
    "diagnose": groma.diagnose,
    "evaluate_lines": lambda scene: groma.evaluate_lines(scene, SCENE),
    "evaluate_lines with": lambda scene: groma.evaluate_lines(SCENE, scene),
    "evaluate_planes": lambda scene: groma.evaluate_planes(scene, SCENE),
    "evaluate_poses": lambda scene: groma.evaluate_poses(SCENE, scene),
    "reliability": groma.reliability,
    "uncertainty": groma.uncertainty,
    "write_parts": lambda scene: groma.write_parts(scene, "parts"),
    "write_report": lambda scene: groma.write_report("page.html", None, scene),
    "write_scene": lambda scene: groma.write_scene(scene, "a.npz"),
    **{
        writer.__name__: lambda scene, writer=writer: writer(scene, "a")
        for writer in (
            io.write_archive, io.write_bal, io.write_colmap, io.write_dxf, io.write_gltf, io.write_obj, io.write_ply,
            io.write_recording, io.write_transforms,
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
        (lambda: groma.cameras.model(1), "name must be a str; got int"),  # type: ignore[arg-type]
        (lambda: holistic(4, noise_px=float("nan")), "noise_px must be a standard deviation, 0 or more; got nan"),
        (lambda: holistic(4, structure=-1.0), "structure must be a standard deviation, 0 or more; got -1"),
        (lambda: corridor(12, noise_px=float("inf")), "noise_px must be a standard deviation, 0 or more; got inf"),
    ],
)
def test_other_kinds_are_named(function, words):
    with pytest.raises(InputError, match=words):
        function()


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
