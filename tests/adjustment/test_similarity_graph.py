# SPDX-License-Identifier: BSD-3-Clause
"""Graphs of similarities: a ring whose scale drifts is closed, and what cannot be adjusted is refused."""

import numpy as np
import pytest

from groma.adjustment.graphs.similarity_graph import SimilarityMotions, adjust_similarity_graph
from groma.errors import InputError, ShapeError
from groma.geometry import quaternion, se3, sim3, so3

COUNT = 40
#: Noise of neighbours: translation, rotation, logarithm of the scale.
SIGMA = np.array([0.02] * 3 + [0.01] * 3 + [0.02])


def _ring() -> np.ndarray:
    """Cameras (COUNT, 7) on a ring, cam_from_world."""
    angle = 2 * np.pi * np.arange(COUNT) / COUNT
    R = so3.exp(np.outer(angle, [0, 1.0, 0]))
    center = np.stack([3 * np.sin(angle), 0.2 * np.sin(2 * angle), 3 * np.cos(angle)], axis=1)
    return se3.inverse(np.hstack([quaternion.from_matrix(R), center]))


def _drifted(growth: float) -> tuple[np.ndarray, np.ndarray, SimilarityMotions]:
    """Cameras with units of their own, the same as odometry without scale has them, and motions with a loop."""
    scale = np.exp(np.linspace(0.0, growth, COUNT))
    truth = np.column_stack([_ring(), np.ones(COUNT)])
    truth[:, 4:] *= scale[:, None]
    odometry = sim3.compose(truth[:-1], sim3.inverse(truth[1:]))
    odometry[:, 7] = 1.0
    start = [truth[0]]
    for motion in odometry:
        start.append(sim3.compose(sim3.inverse(motion), start[-1]))
    loop = sim3.compose(truth[:1], sim3.inverse(truth[-1:]))
    rows = np.arange(COUNT - 1)
    covariance = np.tile(np.diag(SIGMA**2), (COUNT, 1, 1))
    measured = np.concatenate([odometry, loop])
    return (
        truth,
        np.array(start),
        SimilarityMotions(np.append(rows, 0), np.append(rows + 1, COUNT - 1), measured, covariance),
    )


def _centers(cam_from_world: np.ndarray) -> np.ndarray:
    return sim3.inverse(cam_from_world)[:, 4:7]


@pytest.mark.parametrize("growth", [-0.6, 0.4])
def test_a_loop_takes_the_drift_of_scale_out(growth):
    truth, start, motions = _drifted(growth)
    result = adjust_similarity_graph(start, motions)
    assert result.report.converged
    before, after = (
        np.linalg.norm(_centers(at) - _centers(truth), axis=1).max() for at in (start, result.cam_from_world)
    )
    # Drift in proportion to the way, which a graph of equal neighbours spreads evenly: what is left is of second order.
    assert before > 0.8
    assert after < 0.05 * before
    np.testing.assert_allclose(np.log(result.cam_from_world[:, 7]), np.log(truth[:, 7]), atol=0.05)
    np.testing.assert_array_equal(result.cam_from_world[0], start[0])


def test_the_error_is_shared_in_proportion_to_variances():
    """Two motions measure the same scale apart by 0.3; the one with a third of the deviation gets a tenth."""
    cameras = np.tile(sim3.identity(), (2, 1))
    measured = np.tile(sim3.identity(), (2, 1))
    measured[1, 7] = np.exp(-0.3)
    covariance = np.stack([np.eye(7), 9.0 * np.eye(7)])
    result = adjust_similarity_graph(
        cameras, SimilarityMotions(np.zeros(2, int), np.ones(2, int), measured, covariance)
    )
    assert np.log(result.cam_from_world[1, 7]) == pytest.approx(0.03, abs=1e-6)
    np.testing.assert_allclose(result.chi_square, [0.03**2, 0.27**2 / 9.0], rtol=1e-4)


def test_what_is_refused():
    truth, start, motions = _drifted(0.1)
    none = SimilarityMotions(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 8)), np.zeros((0, 7, 7)))
    with pytest.raises(InputError, match="no motions"):
        adjust_similarity_graph(start, none)
    with pytest.raises(InputError, match=f"the cameras are 0 to {COUNT - 2}"):
        adjust_similarity_graph(start[:-1], motions)
    with pytest.raises(ShapeError, match=r"covariance must have shape \(1, 7, 7\)"):
        SimilarityMotions(np.zeros(1, int), np.ones(1, int), truth[:1], np.zeros((1, 6, 6)))
