# SPDX-License-Identifier: BSD-3-Clause
r"""Are the covariances true? A Monte-Carlo test on scenes whose truth and noise are known.

Scenes are drawn, measured with noise, adjusted, and compared with the truth. If a covariance is right, the *normalised
estimation error squared* of a variable with d degrees of freedom

.. math:: \mathrm{NEES} = e^\top \Sigma^{-1} e, \qquad e = \mathrm{local}(\text{estimate}, \text{truth}),

has the mean d. Its average over the variables of a kind and over all runs is compared with the band in which it falls
with 95 % probability. Variables of one run are correlated through the cameras, which widens the band: with C the joint
covariance of all of them, whitened block by block, the sum of their NEES has the variance
:math:`2\lVert C\rVert_F^2`; a scaled :math:`\chi^2` of that mean and variance gives the band.

Two problems are tested, both with unknown intrinsics and without robust losses. With ``held`` the first camera and the
scale are held at their true values, and everything is adjusted together: points, lines, planes and directions, and the
relations between them (:mod:`groma.adjustment.consistency_scenes`). With ``inner`` nothing is held, and errors are
freed of their common motion as the covariances are (:mod:`groma.solver.covariance.datum`). There are no relations then:
they are measured in lengths, so the scale of the scene is not quite free with them.

References
----------
Bar-Shalom, Li and Kirubarajan, *Estimation with Applications to Tracking and Navigation*, 2001, section 5.4.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from groma._typing import FloatArray
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.consistency_scenes import STRUCTURE_SIGMA_PX, drawn
from groma.errors import InputError
from groma.problem.problem import Problem
from groma.solver.covariance.marginals import Covariances
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

#: Names of the groups of variables in rows of the result.
KINDS = {
    "frames": "poses",
    "points": "points",
    "lines": "lines",
    "planes": "planes",
    "directions": "directions",
    "intrinsics/PINHOLE": "intrinsics",
}
#: Probability of the band, and of the wider one outside of which the check fails (convention: levels of a test).
BAND, LIMIT = 0.95, 0.999
#: Runs of which the variance is taken to be that of all (cost: an inversion each).
SAMPLED = 5
#: Scenes that are drawn, and images of each (cost: time).
RUNS, NUM_IMAGES = 100, 15


@dataclass(frozen=True)
class ConsistencyRow:
    """The average NEES of one kind of variable."""

    #: ``held`` or ``inner``.
    gauge: str
    #: ``poses``, ``points``, ``lines``, ``planes``, ``directions`` or ``intrinsics``.
    kind: str
    #: Degrees of freedom: the mean that is expected.
    dof: int
    #: Errors averaged.
    count: int
    average: float
    #: Where the average falls with 95 % probability if the covariances are right.
    low: float
    high: float
    #: Whether it does.
    inside: bool
    #: Whether it lies in the 99.9 % band, outside of which the check fails.
    passed: bool


@dataclass(frozen=True)
class ConsistencyReport:
    """Average NEES by gauge and kind."""

    runs: int
    seed: int
    rows: tuple[ConsistencyRow, ...]

    @property
    def passed(self) -> bool:
        """Whether there is a row and every row passed."""
        return bool(self.rows) and all(row.passed for row in self.rows)

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain values, for JSON."""
        return {"passed": self.passed, "runs": self.runs, "seed": self.seed, "rows": [asdict(row) for row in self.rows]}


def consistency(
    runs: int = RUNS,
    seed: int = 0,
    num_images: int = NUM_IMAGES,
    noise_px: float = 0.5,
    believed_px: float | None = None,
    gauges: tuple[str, ...] = ("held", "inner"),
) -> ConsistencyReport:
    """Compare covariances with the errors that they predict.

    Parameters
    ----------
    runs : int
        Scenes drawn for each gauge, at least 2.
    seed : int
        Everything random follows from it.
    num_images : int
        Size of the scenes; see :func:`groma.scene.synthetic.holistic`.
    noise_px : float
        Standard deviation of the measurements.
    believed_px : float, optional
        What the adjustment takes it for; the same by default. Another value shows that the check can fail.
    gauges : tuple of str
        ``held``, ``inner`` or both.

    Returns
    -------
    ConsistencyReport
        One row for each gauge and kind.

    Raises
    ------
    InputError
        If there are fewer than two runs, or a gauge is not known.
    """
    if runs < 2:
        raise InputError(f"At least 2 runs are needed for an average; got {runs}.")
    rows: list[ConsistencyRow] = []
    for gauge in gauges:
        if gauge not in ("held", "inner"):
            raise InputError(f"gauges must be 'held' or 'inner'; got {gauge!r}.")
        rows += _check(runs, seed, num_images, noise_px, noise_px if believed_px is None else believed_px, gauge)
    return ConsistencyReport(runs, seed, tuple(rows))


def _check(
    runs: int, seed: int, num_images: int, noise_px: float, believed_px: float, gauge: str
) -> list[ConsistencyRow]:
    options = AssemblyOptions(
        gauge="first_camera" if gauge == "held" else "free",
        planes=gauge == "held",
        point_sigma_px=believed_px,
        line_sigma_px=believed_px,
        structure_sigma_px=STRUCTURE_SIGMA_PX,
        refine_intrinsics=True,
        refine_principal_point=True,
        drop_behind=False,
    )
    values: dict[str, list[float]] = {}
    spreads: dict[str, list[tuple[float, float]]] = {}
    dofs: dict[str, int] = {}
    for run in range(runs):
        rng = np.random.default_rng([seed, run, gauge == "held"])
        truth = assemble(drawn(num_images, noise_px, rng, options.planes), options).problem
        estimate = solve(truth, SolverOptions(function_tolerance=1e-12, max_iterations=30)).problem
        covariances = Covariances(estimate, gauge=gauge)
        errors = covariances.in_datum(
            {
                name: group.manifold.local(group.state, truth.variables[name].state)
                for name, group in estimate.variables.items()
            }
        )
        for name, kind in KINDS.items():
            if name not in errors:
                continue
            values.setdefault(kind, []).extend(_nees(errors[name], covariances.of(name)))
            dofs[kind] = estimate.variables[name].manifold.dof
            if run < SAMPLED:
                spreads.setdefault(kind, []).append(_spread(covariances, estimate, name))
    return [_row(gauge, kind, dofs[kind], np.array(values[kind]), runs, spreads[kind]) for kind in dofs]


def _nees(errors: FloatArray, covariance: FloatArray) -> FloatArray:
    """NEES of the variables whose covariance is positive definite; those held, even in part, are left out."""
    diagonal = np.einsum("nii->ni", covariance)
    free = np.isfinite(diagonal).all(axis=1) & (diagonal > 0).all(axis=1)
    e, sigma = errors[free], covariance[free]
    return np.einsum("ni,ni->n", e, np.linalg.solve(sigma, e[:, :, None])[:, :, 0])


def _spread(covariances: Covariances, problem: Problem, name: str) -> tuple[float, float]:
    """Mean of the summed NEES of one run, and half of its variance."""
    blocks = covariances.of(name)
    diagonal = np.einsum("nii->ni", blocks)
    free = np.flatnonzero(np.isfinite(diagonal).all(axis=1) & (diagonal > 0).all(axis=1))
    joint = covariances.joint([(name, int(i)) for i in free])
    dof = problem.variables[name].manifold.dof
    W = np.zeros_like(joint)
    for k, i in enumerate(free):
        at = slice(k * dof, (k + 1) * dof)
        W[at, at] = np.linalg.inv(np.linalg.cholesky(blocks[i]))
    return float(len(joint)), float(((W @ joint @ W.T) ** 2).sum())


def _row(
    gauge: str, kind: str, dof: int, values: FloatArray, runs: int, spreads: list[tuple[float, float]]
) -> ConsistencyRow:
    """Average, and the bands of a chi square that has the mean and the variance of the sum over all runs."""
    mean, half_variance = np.mean(spreads, axis=0)
    degrees = runs * mean**2 / half_variance
    average = float(values.mean())
    low, high = (float(dof / degrees * 2.0 * gammaincinv(0.5 * degrees, 0.5 + side * BAND / 2)) for side in (-1, 1))
    least, most = (float(dof / degrees * 2.0 * gammaincinv(0.5 * degrees, 0.5 + side * LIMIT / 2)) for side in (-1, 1))
    return ConsistencyRow(
        gauge, kind, dof, len(values), average, low, high, low <= average <= high, least <= average <= most
    )
