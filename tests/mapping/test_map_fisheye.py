# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of a fisheye of ninety degrees to its corners, rendered and mapped: lines on the walls they show."""

import _facade
import numpy as np

from groma.mapping.map import map_images
from groma.mapping.options import MapOptions


def test_a_fisheye_is_mapped(tmp_path, monkeypatch):
    monkeypatch.setattr(_facade, "FOCAL", 220.0)
    scene = _facade.facade(tmp_path / "images", 5, model="SIMPLE_RADIAL_FISHEYE", extra=(-0.02,))
    result = map_images(tmp_path / "images", tmp_path / "work", scene, MapOptions(threads=1))
    ends = result.scene.lines.segments
    assert len(ends) > 60
    normals = [np.cross(wall[1], wall[2]) / np.linalg.norm(np.cross(wall[1], wall[2])) for wall in _facade.WALLS]
    away = [np.abs((ends - wall[0]) @ normal).max(axis=1) for wall, normal in zip(_facade.WALLS, normals, strict=True)]
    # A pixel is 1/220 of the distance, which is five: 0.02; over short baselines several times that across the wall.
    assert np.median(np.min(away, axis=0)) < 0.02
    assert np.quantile(np.min(away, axis=0), 0.9) < 0.08
    assert set(result.scene.cameras.models) == {"SIMPLE_RADIAL_FISHEYE"}
