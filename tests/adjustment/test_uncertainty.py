# SPDX-License-Identifier: BSD-3-Clause
"""Uncertainty of a scene: shapes and units, segment ends against their motion, both gauges; the diagnosis of a scene
calls things by their names."""

import json

import numpy as np
import pytest

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.diagnosis import diagnose_scene
from groma.adjustment.uncertainty import position_sigma, uncertainty
from groma.errors import InputError
from groma.evaluation.alignment import align_points
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


@pytest.mark.compiled
def test_relations_do_not_tell_the_scale():
    """Points on lines and planes miss these by little, and by less in a smaller scene: the scale is free all the same.

    With inner constraints the ellipses are those of the errors that occur, and no larger than without relations.
    """
    truth = holistic(6, noise_px=0.0, seed=2).truth
    options = AssemblyOptions(point_sigma_px=0.5, line_sigma_px=0.5)
    found, alone = (uncertainty(scene, options, gauge="inner") for scene in (truth, truth.points_only()))
    assert found.covariances.motions.count == 7
    sizes = [position_sigma(one.centers) for one in (found, alone)]
    assert (sizes[0] < 1.02 * sizes[1]).all() and sizes[0].min() > 0.3 * sizes[1].min()
    rng, squares = np.random.default_rng(0), []
    seen, segments = truth.point_observations, truth.line_observations
    for _ in range(12):
        drawn = truth.replace(
            point_observations=seen.replace(pixel=seen.pixel + rng.normal(size=seen.pixel.shape) * 0.5),
            line_observations=segments.replace(
                segment=segments.segment + rng.normal(size=segments.segment.shape) * 0.5
            ),
        )
        told = AdjustOptions(loss="none", point_sigma_px=0.5, line_sigma_px=0.5, check_lens=False)
        centers = adjust(drawn, told).scene.cam_centers_in_world
        true = truth.cam_centers_in_world
        squares.append(np.sum((align_points(centers, true).points(centers) - true) ** 2, axis=1))
    # 12 draws of 6 cameras, 11 independent coordinates each
    assert np.sqrt(np.mean(squares) / np.mean(sizes[0] ** 2)) == pytest.approx(1.0, abs=0.25)
