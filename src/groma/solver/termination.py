# SPDX-License-Identifier: BSD-3-Clause
"""Why a solve stopped. Each member carries a sentence for the user."""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from groma.solver.damped_problem import Trial
    from groma.solver.options import SolverOptions

#: A step below this fraction of the states changes nothing in double precision.
NO_CHANGE = 1e-14
#: A decrease below this fraction of the cost may be one of rounding: the sum of many squares has some digits less than
#: double precision.
ROUNDING = 1e-14


class Termination(Enum):
    """Why a solve stopped; ``sentence`` explains it, with causes and remedies."""

    #: A step changes the cost by less than ``function_tolerance`` of it.
    COST_CONVERGED = ("cost_converged", True, "Converged: further steps hardly change the cost.")
    #: The largest component of the gradient is below ``gradient_tolerance``.
    GRADIENT_CONVERGED = ("gradient_converged", True, "Converged: the gradient has vanished.")
    #: Steps are below ``step_tolerance``.
    STEP_CONVERGED = ("step_converged", True, "Converged: steps have become negligible.")
    MAX_ITERATIONS = (
        "max_iterations",
        False,
        "Stopped at the iteration limit before convergence. The result is the best state found; allow more steps "
        "(--max-iterations, max_iterations=), or check for outliers (a robust loss helps) and weak landmarks.",
    )
    DAMPING_EXHAUSTED = (
        "damping_exhausted",
        False,
        "Stopped: no step reduced the cost, even with the strongest damping. Causes: (a) the state is at a minimum to "
        "machine precision, (b) a Jacobian of a factor of your own is wrong (groma.testing.check_factor tells), "
        "(c) outliers of extreme size.",
    )
    STEP_REFUSED = (
        "step_refused",
        False,
        "Stopped: a Gauss-Newton step did not reduce the cost. The start is too far from the minimum, or the problem "
        "too nonlinear, for undamped steps; use method='levenberg_marquardt'.",
    )
    SINGULAR = (
        "singular",
        False,
        "Stopped: the normal equations are singular, and Gauss-Newton steps are not damped. Hold variables constant or "
        "add priors (a scene seen by cameras alone is free to move, turn and scale), or use "
        "method='levenberg_marquardt'.",
    )
    NOT_FINITE = (
        "not_finite",
        False,
        "Stopped: the cost is not finite at the start. Causes: (a) NaN or infinite measurements or noise, "
        "(b) states of absurd size. Check the input.",
    )
    NO_FACTOR_COUNTS = (
        "no_factor_counts",
        False,
        "Stopped: no factor counts. Causes: (a) none can be evaluated at the start (points behind their cameras or in "
        "their focal plane, lines through camera centres), (b) all have a weight of zero, (c) a loss "
        "rejects all of them (take a wider one). Nothing was moved; check poses, landmarks and noise.",
    )
    NOTHING_TO_DO = ("nothing_to_do", True, "Nothing to solve: there are no factors, or everything is held constant.")
    STOPPED_BY_CALLER = (
        "stopped_by_caller",
        False,
        "Stopped by the progress callback. The result is the best state found.",
    )

    def __init__(self, key: str, converged: bool, sentence: str) -> None:
        self.key = key
        self.converged = converged
        self.sentence = sentence


def cost_converged(decrease: float, previous: float, gain_ratio: float, withheld: float, tolerance: float) -> bool:
    r"""Whether the cost has converged after an accepted step: it fell, or would fall next, by too little to continue.

    What the next step will bring is known well enough without taking it. Steps shrink by the ratio they have shrunk
    by, or by what the quadratic model was wrong, whichever is more; and what the damping has held back,
    :math:`\lambda\,\delta^\top D\,\delta`, is still to come. With d the decrease, :math:`d_0` the one before and
    :math:`\varrho` the gain ratio,

    .. math:: d_1 \approx d \max(d / d_0,\ |1 - \varrho|) + \lambda\,\delta^\top D\,\delta .

    That holds near the minimum, where convergence is quadratic or better than its history: d itself must be at most
    :math:`\sqrt{\text{tolerance}}`.

    Parameters
    ----------
    decrease, previous
        Decrease of the cost in this step, and in the step before, relative to the costs before them; the latter is 0
        where there was none, or where it was refused.
    gain_ratio
        Actual over predicted decrease.
    withheld
        What the damping holds back, relative to the cost.
    tolerance
        The relative decrease that does not matter.
    """
    if decrease <= tolerance:
        return True
    if previous <= 0.0 or decrease > tolerance**0.5:
        return False
    return decrease * max(decrease / previous, abs(1.0 - gain_ratio)) + withheld <= tolerance


def is_beyond_cost(trial: Trial, best: Trial) -> bool:
    r"""Whether a step promises less than the rounding of the cost, so that the cost cannot decide whether it is good.

    The gradient still can: it is exact to more digits. Near the minimum the cost F says nothing of states within
    :math:`\sqrt{2 \epsilon F}` standard deviations. Such a step is taken without asking the cost.
    """
    rounding = ROUNDING * best.cost
    told = trial.promised > rounding or trial.num_hidden > best.num_hidden
    return not told and trial.cost - best.cost <= 10.0 * rounding


class Criteria:
    """The tests for convergence after every step."""

    def __init__(self, options: SolverOptions) -> None:
        self._options = options
        #: Relative decrease in the last step, 0 where it was refused.
        self.fell = 0.0
        #: Predicted decrease of the last step, where the cost cannot decide.
        self._promised = np.inf

    def after_accepted(self, trial: Trial, best: Trial) -> Termination | None:
        """Return why to stop after a step from ``best`` to ``trial``."""
        if trial.all_converged is not None:
            return Termination.COST_CONVERGED if trial.all_converged else None
        tolerance = self._options.function_tolerance
        if is_beyond_cost(trial, best):  # if configured, continue as long as the gradient decreases
            before, self._promised = self._promised, trial.promised
            smaller = tolerance == 0.0 and trial.promised < 0.25 * before
            return None if smaller and trial.relative_length > NO_CHANGE else Termination.COST_CONVERGED
        before, self.fell = self.fell, (best.cost - trial.cost) / best.cost
        withheld = trial.withheld / best.cost
        if cost_converged(self.fell, before, trial.gain_ratio, withheld, tolerance):
            return Termination.COST_CONVERGED
        return Termination.STEP_CONVERGED if trial.relative_length <= self._options.step_tolerance else None

    def after_refused(self, trial: Trial, best: Trial) -> Termination | None:
        """Return why to stop after a step that was refused."""
        self.fell = 0.0
        if trial.all_converged is not None:
            return Termination.COST_CONVERGED if trial.all_converged else None
        if trial.promised <= self._options.function_tolerance * best.cost:
            return Termination.COST_CONVERGED  # even as promised the step would have ended the solve
        return Termination.DAMPING_EXHAUSTED if trial.relative_length <= NO_CHANGE else None
