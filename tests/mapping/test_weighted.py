# SPDX-License-Identifier: BSD-3-Clause
"""Scenes whose observations have weights: their noise is estimated, by ``groma adjust`` too."""

import json

import numpy as np
import pytest

from groma.adjustment.adjust import adjust
from groma.cli.main import run
from groma.io import read_scene, write_scene
from groma.mapping.noise.weighted import adjust_weighted
from groma.scene import synthetic
from groma.scene.counts import has_weights

pytestmark = [pytest.mark.kernels, pytest.mark.compiled]
NOISE = 0.15


@pytest.fixture(scope="module")
def scene():
    """A scene with pixels of two kinds, off by 0.15 and 0.45 px, of which only the ratio is told."""
    made = synthetic.holistic(20, seed=5, noise_px=1e-6)
    rng, truth, start = np.random.default_rng(1), made.truth, made.start
    tables = {}
    for name, field in (("point_observations", "pixel"), ("line_observations", "segment")):
        table = getattr(truth, name)
        sigma = np.where(rng.random(len(table)) < 0.5, 1.0, 3.0)
        value = getattr(table, field) + NOISE * sigma[:, None] * rng.normal(size=getattr(table, field).shape)
        tables[name] = table.replace(**{field: value, "sigma": sigma})
    return start.replace(**tables)


def test_the_noise_is_that_of_the_residuals(scene):
    assert has_weights(scene)
    result, chosen = adjust_weighted(scene)
    assert chosen.point_sigma_px == pytest.approx(NOISE, rel=0.15)
    assert chosen.line_sigma_px == pytest.approx(NOISE, rel=0.25)
    again, _ = adjust_weighted(result.scene)  # it is adjusted already
    assert again.report.solve.initial_cost == pytest.approx(again.report.solve.final_cost, rel=0.02)
    moved = np.abs(again.scene.points.xyz - result.scene.points.xyz).max()
    assert moved < 0.1 * np.abs(adjust(result.scene).scene.points.xyz - result.scene.points.xyz).max()


def test_covariances_of_the_command_are_for_this_noise(scene, tmp_path):
    write_scene(scene, tmp_path / "weighted.npz")
    one = read_scene(tmp_path / "weighted.npz")
    write_scene(
        one.replace(
            point_observations=one.point_observations.replace(sigma=np.ones(one.num_point_observations)),
            line_observations=one.line_observations.replace(sigma=np.ones(one.num_line_observations)),
        ),
        tmp_path / "plain.npz",
    )
    known = {}
    for name in ("weighted", "plain"):
        command = ["adjust", str(tmp_path / f"{name}.npz"), "--covariance", str(tmp_path / f"{name}.json")]
        assert run([*command, "--no-diagnosis", "--json", str(tmp_path / f"{name}-report.json")]) == 0
        report = json.loads((tmp_path / f"{name}-report.json").read_text())
        known[name] = report["uncertainty"]
    # A pixel is assumed without weights: 0.15 and 0.45 of it are here.
    weighted, plain = (known[name]["center"]["median"] for name in ("weighted", "plain"))
    assert 0.1 < weighted / plain < 0.4
