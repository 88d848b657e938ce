# SPDX-License-Identifier: BSD-3-Clause
"""Uncertainty of a scene: shapes and units, segment ends against their motion, both gauges; the diagnosis of a scene
calls things by their names."""

import json

import numpy as np
import pytest

from groma.adjustment.diagnosis import diagnose_scene
from groma.adjustment.uncertainty import uncertainty
from groma.errors import InputError
from groma.scene.observations import Relations
from groma.scene.synthetic.scenes import holistic
from groma.solver.covariance import quantities

pytestmark = pytest.mark.kernels

SCENE = holistic(10, 0).truth


def test_everything_has_a_covariance_in_scene_units():
    found = uncertainty(SCENE)
    assert found.gauge == "held"
    assert found.poses.shape == (10, 6, 6)
    assert np.abs(found.poses[0]).max() == 0.0
    assert found.segment_ends.shape == (SCENE.num_lines, 2, 3, 3)
    for name in ("points", "lines", "planes", "segment_ends"):
        assert np.isfinite(getattr(found, name)).all()
    # across the line only, and it grows with the noise
    d = SCENE.lines.segments[:, 1] - SCENE.lines.segments[:, 0]
    along = np.einsum("ni,nkij,nj->nk", d, found.segment_ends, d)
    assert np.abs(along).max() < 1e-12
    twice = uncertainty(SCENE, sigma0=2.0)
    np.testing.assert_allclose(twice.points, 4 * found.points)
    # unit normals and directions do not change their length
    n = SCENE.planes.hesse[:, :3]
    assert np.abs(np.einsum("nij,nj->ni", found.planes[:, :3, :3], n)).max() < 1e-12
    json.dumps(found.to_dict(), allow_nan=False)
    angle = quantities.angle_between_planes(found.covariances, ("planes", 0), ("planes", 1))
    assert 0 < angle.sigma < 0.01


def test_segment_ends_are_those_of_the_moved_line():
    found = uncertainty(SCENE)
    k = 3
    end = SCENE.lines.segments[k, 1]
    d = SCENE.lines.segments[k, 1] - SCENE.lines.segments[k, 0]
    d /= np.linalg.norm(d)

    def crossing(line):  # where the line meets the plane across the segment at its end
        n, w = d, -d @ end
        m, v = line[:3], line[3:]
        return (np.cross(n, m) - w * v) / (n @ v)

    np.testing.assert_allclose(crossing(np.concatenate([np.cross(end, d), d])), end, atol=1e-12)
    derived = found.covariances.derived(crossing, [("lines", k)])
    np.testing.assert_allclose(derived.covariance, found.segment_ends[k, 1], rtol=1e-5, atol=1e-12)


def test_free_network():
    scene = SCENE.replace(relations=Relations())
    found = uncertainty(scene)
    assert found.gauge == "inner"
    held = uncertainty(scene, gauge="held")
    assert np.trace(found.centers.sum(axis=0)) < np.trace(held.centers.sum(axis=0))
    with pytest.raises(InputError, match="gauge"):
        uncertainty(scene, gauge="free")


def test_diagnosis_uses_the_names_of_the_scene():
    keep = ~((SCENE.point_observations.image_idx == 4) & (SCENE.point_observations.point_idx > 3))
    lines = SCENE.line_observations.image_idx != 4
    scene = SCENE.replace(
        point_observations=SCENE.point_observations.take(np.flatnonzero(keep)),
        line_observations=SCENE.line_observations.take(np.flatnonzero(lines)),
    )
    diagnosis = diagnose_scene(scene)
    assert any("00005.png" in sentence for sentence in diagnosis.sentences), diagnosis.sentences
