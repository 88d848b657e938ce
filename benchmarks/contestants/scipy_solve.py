# SPDX-License-Identifier: BSD-3-Clause
"""SciPy's ``least_squares`` on a BAL file, as its cookbook does it: ``scipy_solve.py FILE SOLVER THREADS``.

Trust region reflective with a sparse Jacobian and LSMR. SOLVER is ``numeric`` (differences, grouped by the sparsity) or
``analytic`` (vectorised derivatives, the strongest form). Needs numpy and scipy, not groma.
"""

from __future__ import annotations

import sys

import numpy as np
import scipy
from _common import MAX_STEPS, TOLERANCE, Curve, read_bal, report
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix


def skew(vectors: np.ndarray) -> np.ndarray:
    """Return cross product matrices (N, 3, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)


class Problem:
    """Residuals and derivatives of all observations at once."""

    def __init__(self, path: str) -> None:
        self.camera_of, self.point_of, self.pixels, self.cameras, self.points = read_bal(path)
        count, start = len(self.pixels), 9 * len(self.cameras)
        columns = np.concatenate(
            [9 * self.camera_of[:, None] + np.arange(9), start + 3 * self.point_of[:, None] + np.arange(3)], axis=1
        )
        self.columns = np.repeat(columns, 2, axis=0).ravel()
        self.row_start = 12 * np.arange(2 * count + 1)
        self.shape = (2 * count, start + 3 * len(self.points))

    def start(self) -> np.ndarray:
        """Return the unknowns at the start."""
        return np.concatenate([self.cameras.ravel(), self.points.ravel()])

    def _split(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        border = 9 * len(self.cameras)
        return unknowns[:border].reshape(-1, 9)[self.camera_of], unknowns[border:].reshape(-1, 3)[self.point_of]

    @staticmethod
    def _rotations(vectors: np.ndarray) -> np.ndarray:
        angle = np.linalg.norm(vectors, axis=1)
        cross = skew(vectors / np.maximum(angle, 1e-300)[:, None])
        sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
        return np.eye(3) + sine * cross + (1 - cosine) * cross @ cross

    def residuals(self, unknowns: np.ndarray) -> np.ndarray:
        """Return predicted minus measured pixels, flat."""
        camera, point = self._split(unknowns)
        place = np.einsum("nij,nj->ni", self._rotations(camera[:, :3]), point) + camera[:, 3:6]
        image = -place[:, :2] / place[:, 2:]
        square = (image**2).sum(1)
        scale = camera[:, 6] * (1 + square * (camera[:, 7] + camera[:, 8] * square))
        return (image * scale[:, None] - self.pixels).ravel()

    def jacobian(self, unknowns: np.ndarray) -> csr_matrix:
        """Return the derivative of the residuals by all unknowns."""
        camera, point = self._split(unknowns)
        rotation = self._rotations(camera[:, :3])
        turned = np.einsum("nij,nj->ni", rotation, point)
        place = turned + camera[:, 3:6]
        image = -place[:, :2] / place[:, 2:]
        square = (image**2).sum(1)
        f, k1, k2 = camera[:, 6], camera[:, 7], camera[:, 8]
        bend = 1 + square * (k1 + k2 * square)
        by_image = (f * bend)[:, None, None] * np.eye(2)
        by_image += (2 * f * (k1 + 2 * k2 * square))[:, None, None] * image[:, :, None] * image[:, None, :]
        image_by_place = np.zeros((len(f), 2, 3))
        image_by_place[:, 0, 0] = image_by_place[:, 1, 1] = -1 / place[:, 2]
        image_by_place[:, :, 2] = -image / place[:, 2:]
        by_place = by_image @ image_by_place
        # a change d of the rotation vector turns from the left by J d, J the left Jacobian of the rotation group
        angle = np.maximum(np.linalg.norm(camera[:, :3], axis=1), 1e-9)[:, None, None]
        cross = skew(camera[:, :3])
        left = np.eye(3) + (1 - np.cos(angle)) / angle**2 * cross + (angle - np.sin(angle)) / angle**3 * (cross @ cross)
        block = np.concatenate(
            [
                -by_place @ skew(turned) @ left,
                by_place,
                (bend[:, None] * image)[:, :, None],
                (f * square)[:, None, None] * image[:, :, None],
                (f * square**2)[:, None, None] * image[:, :, None],
                by_place @ rotation,
            ],
            axis=2,
        )
        return csr_matrix((block.ravel(), self.columns, self.row_start), shape=self.shape)

    def pattern(self) -> csr_matrix:
        """Return where the Jacobian is not zero."""
        ones = np.ones(len(self.columns), dtype=np.int8)
        return csr_matrix((ones, self.columns, self.row_start), shape=self.shape)


def main() -> None:
    path, solver, threads = sys.argv[1:]
    problem = Problem(path)
    start = problem.start()
    initial = 0.5 * float(np.sum(problem.residuals(start) ** 2))
    derivative = {"jac": problem.jacobian} if solver == "analytic" else {"jac_sparsity": problem.pattern()}
    curve = Curve()

    def note(intermediate_result) -> None:
        curve.add(intermediate_result.cost)

    found = least_squares(
        problem.residuals, start, **derivative, x_scale="jac", method="trf", tr_solver="lsmr", ftol=TOLERANCE,
        xtol=None, gtol=None, max_nfev=MAX_STEPS, callback=note,
    )  # fmt: skip
    report(
        contestant="scipy",
        version=scipy.__version__,
        solver=solver,
        threads=int(threads),
        **curve.finish(),
        iterations=int(found.nfev) - 1,
        initial_cost=initial,
        final_cost=float(found.cost),
    )


if __name__ == "__main__":
    main()
