# SPDX-License-Identifier: BSD-3-Clause
"""Why a solve stopped. Each member carries a sentence for the user."""

from __future__ import annotations

from enum import Enum


class Termination(Enum):
    """Reason for the end of a solve; ``sentence`` says it in words, with causes and remedies."""

    COST_CONVERGED = (
        "cost_converged",
        True,
        "Converged: the cost hardly falls any more (by less than function_tolerance in a step).",
    )
    GRADIENT_CONVERGED = (
        "gradient_converged",
        True,
        "Converged: the gradient has vanished (its largest component is below gradient_tolerance).",
    )
    STEP_CONVERGED = (
        "step_converged",
        True,
        "Converged: steps have become negligible (below step_tolerance).",
    )
    MAX_ITERATIONS = (
        "max_iterations",
        False,
        "Stopped at max_iterations before convergence. The result is the best state found; raise max_iterations, or "
        "check for outliers (use a robust loss) and weakly determined landmarks.",
    )
    DAMPING_EXHAUSTED = (
        "damping_exhausted",
        False,
        "Stopped: no step reduced the cost, even with the strongest damping. Causes: (a) the state is at a minimum to "
        "machine precision, (b) a Jacobian of an own factor is wrong (run check_factor), (c) outliers of extreme size.",
    )
    NOT_FINITE = (
        "not_finite",
        False,
        "Stopped: the cost is not finite at the start. Causes: (a) NaN or infinite measurements or noise, "
        "(b) states of absurd size. Check the input.",
    )
    NOTHING_TO_DO = (
        "nothing_to_do",
        True,
        "Nothing to solve: there are no factors, or everything is held constant.",
    )
    STOPPED_BY_CALLER = (
        "stopped_by_caller",
        False,
        "Stopped by the progress callback. The result is the best state found.",
    )

    def __init__(self, key: str, converged: bool, sentence: str) -> None:
        self.key = key
        self.converged = converged
        self.sentence = sentence
