# SPDX-License-Identifier: BSD-3-Clause
"""The result of a map: what goes on beside its diagnosis."""

import threading

from groma.execution import work_with
from groma.mapping import result as results
from groma.mapping.result import MapResult


def test_the_noise_of_cameras_is_found_beside_the_diagnosis_and_once(monkeypatch):
    found, begun = [], threading.Event()

    def noise(self):
        begun.set()
        found.append(self)
        return {"gauge": "inner"}

    def diagnose(scene, problem):
        assert begun.wait(60.0)  # alone it would never begin
        return "diagnosis"

    monkeypatch.setattr(MapResult, "pose_uncertainty", noise)
    monkeypatch.setattr(results, "diagnose_scene", diagnose)
    monkeypatch.setattr(results, "_problem_of", lambda scene, told: None)
    result = object.__new__(MapResult)
    result.__dict__.update(scene=type("Scene", (), {"num_images": 1}), adjusted_with=None, num_photographs=0)
    with work_with(2):
        assert result.diagnose() == "diagnosis"
    assert result._camera_noise() == result._camera_noise() == {"gauge": "inner"} and found == [result]
