"""The loop on a problem made by hand: accept, refuse, stretch, rescue, exhaust the damping, stop; Gauss-Newton."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from problems import INTRINSICS, cameras_on_a_ring, pixels_of, scene_problem

from groma._stopwatch import Stopwatch
from groma.errors import InputError
from groma.factors import PointReprojection, VectorPrior
from groma.factors.contract import Ref
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.geometry.manifold import Euclidean
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.solver.damped_problem import Trial
from groma.solver.levenberg_marquardt import MAX_DAMPING, NielsenDamping
from groma.solver.options import SolverOptions
from groma.solver.report import SolveReport
from groma.solver.solve import minimise, solve
from groma.solver.termination import Termination


@dataclass(frozen=True)
class At(Trial):
    x: float = 0.0


class Curve:
    """One unknown x: steps are those for the cost x^2 / 2, damped; what a step really costs is ``cost``."""

    num_factors = 1
    linear_iterations = 3

    def __init__(self, cost=lambda x: 0.5 * x * x, x=8.0, damping=1e-3, hidden=lambda x: 0):
        self._cost, self._hidden, self._damping = cost, hidden, NielsenDamping(damping)
        self.here = At(cost=cost(x), x=x)
        self.calls: list[str] = []

    @property
    def damping(self):
        return self._damping.value

    def start(self):
        self.calls.append("start")
        return self.here

    def linearize(self):
        self.calls.append("linearize")

    def largest_gradient(self):
        return abs(self.here.x)

    def is_curved(self):
        return True

    def at(self, x):
        cost, promised = self._cost(x), 0.5 * self.here.x**2
        ratio = (self.here.cost - cost) / promised
        length = abs(x - self.here.x)
        found = {"gain_ratio": ratio, "promised": promised, "length": length, "relative_length": length / abs(x)}
        return At(cost=cost, num_hidden=self._hidden(x), **found, x=x)

    def try_step(self):
        self.calls.append("try")
        return self.at(self.here.x - self.here.x / (1.0 + self.damping))

    def stretch(self, trial, factor):
        self.calls.append("stretch")
        return self.at(self.here.x + factor * (trial.x - self.here.x))

    def refine(self, trial):
        self.calls.append("refine")
        return trial

    def rescue(self, trial):
        self.calls.append("rescue")
        return trial

    def accept(self, trial):
        self.calls.append("accept")
        self.here = trial
        self._damping.accept(trial.gain_ratio)

    def refuse(self, trial):
        self.calls.append("refuse")
        return self._damping.refuse(trial)


def run(problem, progress=None, **options):
    report = SolveReport()
    report.termination = minimise(problem, SolverOptions(**options), report, Stopwatch(report.seconds), progress)
    return report


def test_a_good_step_is_linearised_tried_refined_and_accepted():
    problem = Curve()
    report = run(problem, max_iterations=1)
    assert problem.calls == ["start", "linearize", "try", "refine", "accept"]
    assert report.termination is Termination.MAX_ITERATIONS
    (record,) = report.history
    assert record.accepted and record.linear_iterations == 3 and record.damping == 1e-3 and record.gradient_max == 8.0
    assert report.initial_cost == 32.0 and report.final_cost == record.cost == problem.here.cost
    assert problem.damping == pytest.approx(1e-3 / 3)


def test_a_bad_step_is_refused_and_the_damping_raised():
    problem = Curve(cost=lambda x: 0.5 * x * x if x > 4.0 else 100.0)
    report = run(problem, max_iterations=3)
    assert problem.calls == ["start", *["linearize", "try", "rescue", "refuse"] * 3]
    assert problem.here.x == 8.0 and report.final_cost == report.initial_cost
    assert [record.damping for record in report.history] == [1e-3, 2e-3, 8e-3]
    assert not any(record.accepted for record in report.history)


@pytest.mark.parametrize("promised, damping", [(4.0, 2e-10), (40.0, 6.4e-9), (2e5, 2.097152e-4)])
def test_dampings_that_would_not_change_a_refused_step_are_skipped(promised, damping):
    """The damping grows by 2, 4, 8, ... in turn, until what it withholds, 2 at 1e-10, would be what was promised."""
    rule = NielsenDamping(1e-10)
    assert rule.refuse(At(cost=1.0, promised=promised, withheld=2.0)) is None
    assert rule.value == pytest.approx(damping)


def test_a_rescued_step_is_accepted():
    problem = Curve(cost=lambda x: 0.5 * x * x if x > 4.0 else 100.0)
    problem.rescue = lambda trial: problem.at(5.0)
    run(problem, max_iterations=1)
    assert problem.here.x == 5.0 and "refine" not in problem.calls


@pytest.mark.parametrize(("offset", "kept"), [(4.0, True), (0.1, False)])
def test_steps_that_gain_more_than_promised_are_stretched(offset, kept):
    """The minimum lies beyond zero, where steps for x^2 / 2 end."""
    problem = Curve(cost=lambda x: 0.5 * (x + offset) ** 2 if kept or x > -1e-6 else 100.0, x=1.0)
    problem.at = lambda x, at=problem.at: replace(at(x), gain_ratio=2.0)
    run(problem, max_iterations=1)
    assert problem.calls[2:4] == ["try", "stretch"]
    assert (problem.here.x < -1.0) == kept


def test_what_a_step_hides_is_put_back():
    """All of the cost vanishes because the only factor cannot be evaluated any more: that is no progress."""
    problem = Curve(cost=lambda x: 0.5 * x * x if x > 4.0 else 0.0, hidden=lambda x: int(x <= 4.0))
    run(problem, max_iterations=2)
    assert problem.calls.count("refuse") == 2


def test_what_a_stretched_step_hides_is_put_back():
    """The step is good; tried at a greater length its only factor cannot be evaluated any more, and costs nothing."""
    problem = Curve(cost=lambda x: 0.5 * x * x + 1.0 if x > 0.0 else 0.0, hidden=lambda x: int(x <= 0.0))
    problem.at = lambda x, at=problem.at: replace(at(x), gain_ratio=2.0)
    run(problem, max_iterations=1)
    assert problem.calls[2:4] == ["try", "stretch"] and 0.0 < problem.here.x < 1.0


def test_singular_systems_raise_the_damping_until_it_is_exhausted():
    problem = Curve()
    problem.try_step = lambda: problem.here.without_step()
    report = run(problem, max_iterations=100)
    assert report.termination is Termination.DAMPING_EXHAUSTED
    assert problem.damping > MAX_DAMPING and "accept" not in problem.calls
    assert all(record.cost == record.step_norm == np.inf and record.gain_ratio == 0.0 for record in report.history)


def test_the_caller_stops_and_the_cost_is_that_of_the_best_states():
    problem = Curve(damping=1.0)
    report = run(problem, progress=lambda record: record.iteration < 2)
    assert report.termination is Termination.STOPPED_BY_CALLER and report.iterations == 2
    assert report.final_cost == problem.here.cost


def test_ends():
    assert run(Curve(x=1e-12)).termination is Termination.GRADIENT_CONVERGED
    assert run(Curve(cost=lambda x: np.nan)).termination is Termination.NOT_FINITE
    assert run(Curve(cost=lambda x: 1.0 + 1e-9 * x)).termination is Termination.COST_CONVERGED
    assert run(Curve(damping=1e9), step_tolerance=0.1, function_tolerance=0.0).termination is Termination.STEP_CONVERGED
    promised_little = Curve(cost=lambda x: 1e9 if x == 8.0 else 2e9)
    assert run(promised_little).termination is Termination.COST_CONVERGED
    tiny = Curve(cost=lambda x: 32.0, damping=1e15)
    assert run(tiny, function_tolerance=0.0).termination is Termination.DAMPING_EXHAUSTED
    settled = Curve()
    settled.try_step = lambda: replace(settled.at(7.0), all_converged=True)
    assert run(settled).termination is Termination.COST_CONVERGED


# ----------------------------------------------------------------------------------------------------- Gauss-Newton


def well_determined(seed=0):
    """Cameras of which two are held, points in front of them, little noise, a start nearby."""
    problem = scene_problem(seed=seed, num_cameras=6, num_points=60, noise=0.1, disturb=1e-3)
    held = np.zeros(6, bool)
    held[:2] = True
    poses = replace(problem.variables["poses"], constant=held)
    return Problem({**problem.variables, "poses": poses}, problem.factors)


@pytest.mark.parametrize("linear_solver", ["dense", "sparse"])
def test_gauss_newton_converges_quadratically(linear_solver):
    problem = well_determined()
    given = {"function_tolerance": 1e-12, "linear_solver": linear_solver}
    damped = solve(problem, SolverOptions(**given)).report
    report = solve(problem, SolverOptions(method="gauss_newton", **given)).report
    assert report.converged and report.iterations <= 5
    assert all(record.damping == 0.0 and record.accepted for record in report.history[:3])
    np.testing.assert_allclose(report.final_cost, damped.final_cost, rtol=1e-9)


def test_gauss_newton_solves_a_linear_problem_in_one_step():
    """Two priors on two coupled vectors: the first step is exact, the second has no gradient left."""
    state, measured = np.zeros((4, 2)), np.arange(8.0).reshape(4, 2)
    prior = VectorPrior(variable=Ref("x", np.arange(4)), measured=measured)
    problem = Problem({"x": Variables(Euclidean(2), state)}, [prior])
    solution = solve(problem, SolverOptions(method="gauss_newton"))
    np.testing.assert_allclose(solution["x"], measured, atol=1e-12)
    assert solution.report.converged and solution.report.iterations <= 2


@pytest.mark.parametrize("linear_solver", ["dense", "sparse"])
@pytest.mark.parametrize("shared_intrinsics", [None, True])
def test_gauss_newton_says_that_a_free_scene_is_singular(linear_solver, shared_intrinsics):
    problem = scene_problem(num_cameras=6, num_points=60, shared_intrinsics=shared_intrinsics)
    report = solve(problem, SolverOptions(method="gauss_newton", linear_solver=linear_solver)).report
    assert report.termination is Termination.SINGULAR and not report.converged
    assert "add priors" in report.termination.sentence
    assert report.final_cost == report.initial_cost


def test_gauss_newton_says_that_a_step_failed():
    """One camera turned by so much that the first undamped step leads away."""
    rng = np.random.default_rng(1)
    poses, points = cameras_on_a_ring(rng, 1), rng.uniform(-1.5, 1.5, (40, 3))
    seen = PointReprojection(
        pose=Ref("poses", np.zeros(40, int)),
        point=Ref("points", np.arange(40)),
        intrinsics=Ref("intrinsics", np.zeros(40, int)),
        camera_model="PINHOLE",
        pixels=pixels_of(poses[np.zeros(40, int)], points),
    )
    chart = POSE_CHARTS["left"]
    variables = {
        "poses": Variables(chart, chart.retract(poses, np.array([[0.0, 0.0, 2.0, 0.2, 1.2, 2.5]]))),
        "intrinsics": Variables(Euclidean(4, "intrinsics"), INTRINSICS[None], True),
        "points": Variables(Euclidean(3, "point"), points, True),
    }
    problem = Problem(variables, [seen])
    report = solve(problem, SolverOptions(method="gauss_newton", eliminate=())).report
    assert report.termination is Termination.STEP_REFUSED
    assert report.final_cost <= report.initial_cost


def test_wrong_options_say_what_to_do():
    with pytest.raises(InputError, match="method='gauss_newton'"):
        SolverOptions(initial_damping=0.0)
    with pytest.raises(InputError, match="method must be one of"):
        SolverOptions(method="newton")
    assert replace(SolverOptions(), max_iterations=3).max_iterations == 3
