# SPDX-License-Identifier: BSD-3-Clause
"""Relations between landmarks as distances and as pixel differences: same truth, no weight to choose, no coupling."""

import numpy as np
import pytest

import groma
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.terms.relations_in_pixels import _join
from groma.problem.lay_out import lay_out
from groma.scene import Relations, synthetic

pytestmark = pytest.mark.kernels


@pytest.fixture(scope="module")
def holistic():
    return synthetic.holistic(20, noise_px=1.0, seed=3)


def test_join_lists_every_pair_of_observation_and_relation():
    landmark = np.array([2, 0, 1, 0, 2])
    relation = np.array([[0, 7], [2, 5], [0, 8], [3, 9]])
    observation, partner = _join(landmark, relation, 4)
    expected = sorted((o, b) for a, b in relation for o in np.flatnonzero(landmark == a))
    assert sorted(zip(observation, partner, strict=True)) == expected
    assert [len(part) for part in _join(landmark, relation[:0], 4)] == [0, 0]


def test_pixel_form_couples_no_landmarks(holistic):
    """Points on lines as distances keep the lines in the reduced system; as pixels everything is eliminated."""
    layouts = {}
    for form in ("metric", "pixels"):
        problem = assemble(holistic.start, AssemblyOptions(structure_form=form)).problem
        layouts[form] = {e.group for e in lay_out(problem).eliminated}
    assert layouts == {"metric": {"points"}, "pixels": {"points", "lines"}}


def test_true_scene_has_no_pixel_difference(holistic):
    problem = assemble(holistic.truth, AssemblyOptions(structure_form="pixels")).problem
    for factor in problem.factors:
        if factor.type_name.endswith("_on_plane_pixels"):
            ambients = tuple(problem.variables[ref.group].ambient() for _, ref in factor.references())
            residual = np.empty((len(factor), factor.residual_size))
            assert factor.residuals(factor.prepare(ambients), 0, len(factor), residual) == 0
            assert np.abs(residual).max() < 1e-8


@pytest.mark.compiled
def test_both_forms_pull_landmarks_to_their_planes(holistic):
    """Against the adjustment without relations, the distances from planes shrink to a fraction."""
    relations = holistic.start.relations
    planar = holistic.start.replace(
        relations=Relations(point_on_plane=relations.point_on_plane, line_on_plane=relations.line_on_plane)
    )

    def distance(scene, planes):
        point, plane = relations.point_on_plane.T
        hesse = planes[plane]
        return np.abs(np.einsum("ni,ni->n", scene.points.xyz[point], hesse[:, :3]) + hesse[:, 3])

    loose = groma.adjust(planar, groma.AdjustOptions(loss="none", structure_sigma_px=1e3)).scene
    free = np.median(distance(loose, loose.planes.hesse))
    for form, share in (("metric", 0.2), ("pixels", 0.75)):
        tied = groma.adjust(planar, groma.AdjustOptions(loss="none", structure_form=form)).scene
        assert np.median(distance(tied, tied.planes.hesse)) < share * free, form


def test_unknown_form_is_refused(holistic):
    with pytest.raises(groma.InputError, match="structure_form"):
        groma.adjust(holistic.start, groma.AdjustOptions(structure_form="inches"))


@pytest.mark.compiled
def test_robust_pixel_form_does_not_drift(holistic):
    """Segments on planes are compared at ends that do not move with the scene; a free gauge would creep for ever."""
    result = groma.adjust(holistic.start, groma.AdjustOptions(structure_form="pixels"))
    assert result.report.solve.converged
    assert result.report.solve.iterations <= 20
