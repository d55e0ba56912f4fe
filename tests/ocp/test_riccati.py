"""Riccati equations: their residuals, each other, the matrix exponential and the closed loop."""

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from ocp.cost import RunningCost
from ocp.models import MODELS, get_model
from ocp.obstacle import Obstacle
from ocp.query import Goal, Query
from ocp.riccati import (
    AlgebraicRiccati,
    LinearQuadratic,
    algebraic_riccati,
    differential_riccati,
    linear_dynamics,
)
from ocp.trajectory import SolveError, Status
from ocp.value import greedy

INTEGRATOR = LinearQuadratic([[0, 1], [0, 0]], [[0], [1]], np.diag([10.0, 1.0]), [[2.0]])
UNSTABLE = LinearQuadratic([[1, 1], [0, 2]], [[0], [1]], np.eye(2), [[1.0]])


def random_problem(seed: int) -> LinearQuadratic:
    """Controllable and observable with probability one."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 5)), int(rng.integers(1, 3))
    root = rng.normal(size=(n, n))
    return LinearQuadratic(
        rng.normal(size=(n, n)),
        rng.normal(size=(n, m)),
        root @ root.T,
        np.diag(rng.uniform(0.5, 2.0, m)),
    )


def by_matrix_exponential(problem: LinearQuadratic, terminal, remaining: float) -> np.ndarray:
    """P with `remaining` seconds to go, from the Hamiltonian matrix (Radon's lemma)."""
    n = problem.n
    S = problem.B @ np.linalg.solve(problem.R, problem.B.T)
    hamiltonian = np.block([[problem.A, -S], [-problem.M, -problem.A.T]])
    both = expm(-hamiltonian * remaining) @ np.vstack([np.eye(n), terminal])
    return both[n:] @ np.linalg.inv(both[:n])


def settling_time(solution: AlgebraicRiccati, tolerance: float) -> float:
    """When the cost that is left is below `tolerance` of the whole.

    |exp(F t)| <= k exp(-rate t), k the condition number of F's eigenvectors; costs go with its
    square and with the condition number of P.
    """
    closed_loop = solution.problem.A - solution.problem.B @ solution.gain()
    k = np.linalg.cond(np.linalg.eig(closed_loop)[1])
    constant = k**2 * np.linalg.cond(solution.P())
    return float(np.log(constant / tolerance) / (2 * solution.decay_rate))


@settings(max_examples=25, derandomize=True, deadline=None)
@given(st.integers(0, 10**6))
def test_algebraic_solution_satisfies_its_equation_and_stabilises(seed):
    problem = random_problem(seed)
    solution = algebraic_riccati(problem)
    A, B, M, R, P = problem.A, problem.B, problem.M, problem.R, solution.P()
    residual = M + A.T @ P + P @ A - P @ B @ np.linalg.inv(R) @ B.T @ P
    assert np.abs(residual).max() <= 1e-9 * (1 + np.abs(P).max()) ** 2
    assert np.array_equal(P, P.T)
    assert np.linalg.eigvalsh(P).min() > 0
    assert np.linalg.eigvals(A - B @ solution.gain()).real.max() < 0


@settings(max_examples=8, derandomize=True, deadline=None)
@given(st.integers(0, 10**6))
def test_differential_solution_agrees_with_the_matrix_exponential_between_steps(seed):
    problem = random_problem(seed)
    terminal = np.eye(problem.n)
    solution = differential_riccati(problem, terminal, 1.0)
    for t in np.linspace(0.0, 1.0, 23):
        exact = by_matrix_exponential(problem, terminal, 1.0 - t)
        assert solution.P(t) == pytest.approx(exact, abs=1e-9 * (1 + np.abs(exact).max()))


def test_the_solution_of_an_unstable_plant_does_not_drift_over_a_long_horizon():
    """Integrated as a full matrix, P's skew part would grow like exp(2 * 4 * 10) here."""
    A = [[0, 0, 1, 0], [0, 0, 0, 1], [0, -1.4, 0, 0], [0, 16.8, 0, 0]]
    pole = LinearQuadratic(A, [[0], [0], [0.95], [-1.4]], 10 * np.eye(4), [[2.0]])
    solution = differential_riccati(pole, 0.5 * np.eye(4), 10.0)
    steps, P = 1000, 0.5 * np.eye(4)
    for _ in range(steps):
        P = by_matrix_exponential(pole, P, 10.0 / steps)
        P = (P + P.T) / 2
    assert solution.P(0.0) == pytest.approx(P, rel=1e-8, abs=1e-8)


def test_differential_solution_starts_at_its_terminal_and_obeys_its_equation():
    terminal = np.array([[2.0, 0.5], [0.5, 1.0]])
    solution = differential_riccati(INTEGRATOR, terminal, 3.0)
    assert solution.P(3.0) == pytest.approx(terminal, abs=1e-14)
    times, step = np.linspace(0.1, 2.9, 15), 1e-4
    rate = (solution.P(times + step) - solution.P(times - step)) / (2 * step)
    # Central differences: step^2 P'''/6 plus rounding, far below 1e-5 here.
    assert rate == pytest.approx(-INTEGRATOR.residual(solution.P(times)), abs=1e-5)


@pytest.mark.parametrize("problem", [INTEGRATOR, UNSTABLE, *map(random_problem, range(3))])
def test_long_horizon_tends_to_the_algebraic_solution(problem):
    algebraic = algebraic_riccati(problem)
    tolerance = 1e-8
    horizon = settling_time(algebraic, tolerance)
    differential = differential_riccati(problem, np.zeros((problem.n, problem.n)), horizon)
    scale = np.abs(algebraic.P()).max()
    assert differential.P(0.0) == pytest.approx(algebraic.P(), abs=tolerance * scale)
    assert np.abs(differential.P(0.9 * horizon) - algebraic.P()).max() > tolerance * scale


@pytest.mark.parametrize("problem", [INTEGRATOR, UNSTABLE, random_problem(7)])
def test_closed_loop_cost_is_the_value(problem):
    """Up to a horizon after which the cost that is left is below the tolerance."""
    solution = algebraic_riccati(problem)
    start = np.linspace(1.0, 2.0, problem.n)
    tolerance = 1e-8
    horizon = settling_time(solution, tolerance)

    def rate(_, z):
        x = z[:-1]
        u = solution.input(x)
        return [*(problem.A @ x + problem.B @ u), x @ problem.M @ x + u @ problem.R @ u]

    run = solve_ivp(rate, (0, horizon), [*start, 0.0], method="DOP853", rtol=1e-11, atol=1e-13)
    assert run.y[-1, -1] == pytest.approx(solution.value(start), rel=10 * tolerance)


def test_finite_horizon_cost_is_the_value_and_other_gains_cost_more():
    terminal, horizon, start = np.diag([3.0, 1.0]), 2.0, np.array([1.0, -2.0])
    solution = differential_riccati(INTEGRATOR, terminal, horizon)

    def cost(factor: float) -> float:
        def rate(t, z):
            x = z[:2]
            u = factor * solution.input(x, t)
            run = x @ INTEGRATOR.M @ x + u @ INTEGRATOR.R @ u
            return [*(INTEGRATOR.A @ x + INTEGRATOR.B @ u), run]

        end = solve_ivp(rate, (0, horizon), [*start, 0.0], rtol=1e-10, atol=1e-12).y[:, -1]
        return float(end[2] + end[:2] @ terminal @ end[:2])

    assert cost(1.0) == pytest.approx(solution.value(start, 0.0), rel=1e-8)
    assert cost(0.9) > cost(1.0) * 1.001
    assert cost(1.1) > cost(1.0) * 1.001


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_scaling_the_cost_scales_the_value(factor):
    scaled = LinearQuadratic(
        INTEGRATOR.A, INTEGRATOR.B, factor * INTEGRATOR.M, factor * INTEGRATOR.R
    )
    terminal = np.eye(2)
    one = differential_riccati(INTEGRATOR, terminal, 2.0)
    other = differential_riccati(scaled, factor * terminal, 2.0)
    assert other.P(0.3) == pytest.approx(factor * one.P(0.3), rel=1e-9)
    assert other.gain(0.3) == pytest.approx(one.gain(0.3), rel=1e-9)


def test_without_any_cost_the_value_is_zero():
    free = LinearQuadratic(INTEGRATOR.A, INTEGRATOR.B, np.zeros((2, 2)), [[1.0]])
    assert not differential_riccati(free, np.zeros((2, 2)), 4.0).P([0.0, 1.7, 4.0]).any()


def test_values_are_vectorised_and_gradients_their_derivative():
    solution = differential_riccati(UNSTABLE, np.eye(2), 2.0)
    rng = np.random.default_rng(0)
    states, times = rng.normal(size=(4, 3, 2)), rng.uniform(0, 2, (4, 3))
    values, gradients = solution.value(states, times), solution.gradient(states, times)
    assert values.shape == (4, 3)
    assert solution.input(states, times).shape == (4, 3, 1)
    assert solution.gain(times).shape == (4, 3, 1, 2)
    for k in range(2):
        step = 1e-5 * np.eye(2)[k]
        slope = solution.value(states + step, times) - solution.value(states - step, times)
        assert gradients[..., k] == pytest.approx(slope / 2e-5, rel=1e-6, abs=1e-7)
    frozen = solution.at(float(times[0, 0]))
    assert frozen.value(states[0, 0]) == pytest.approx(values[0, 0])
    assert frozen.gradient(states)[0, 0] == pytest.approx(gradients[0, 0])
    again = pickle.loads(pickle.dumps(solution))
    assert np.array_equal(again.value(states, times), values)


# From robots and queries


def quadratic_query(name: str, center=None, **changes) -> Query:
    system = get_model(name)
    cost = {"goal": 0.0, "state": tuple(map(tuple, np.eye(system.n))), **changes.pop("cost", {})}
    d = len(system.position)
    return Query(
        model=name,
        goal=Goal(tuple(center or [0.0] * d), 0.1),
        cost=RunningCost(**cost),
        **changes,
    )


LINEAR = [name for name in MODELS if "integrator" in name or "rover" in name]


@pytest.mark.parametrize("name", LINEAR)
def test_the_greedy_policy_of_the_value_is_the_riccati_feedback(name):
    query = quadratic_query(name)
    solution = algebraic_riccati(LinearQuadratic.of_query(query))
    states = np.random.default_rng(1).normal(size=(5, query.system.n))
    assert greedy(query, solution)(states) == pytest.approx(solution.input(states), abs=1e-9)


@pytest.mark.parametrize("name", LINEAR)
def test_the_robots_matrices_give_its_dynamics(name):
    system = get_model(name)
    A, B = linear_dynamics(system)
    x, u = np.linspace(-1, 1, system.n), np.linspace(1, 2, system.m)
    assert A @ x + B @ u == pytest.approx(np.array(system.dynamics(x, u)).ravel(), abs=1e-14)


def test_values_are_measured_from_the_goal():
    query = quadratic_query("double-integrator-2d", center=[1.0, 2.0])
    solution = algebraic_riccati(LinearQuadratic.of_query(query))
    assert solution.value([1.0, 2.0, 0.0, 0.0]) == 0.0
    assert solution.value([2.0, 2.0, 0.0, 0.0]) == pytest.approx(solution.P()[0, 0])
    assert solution.gradient([2.0, 2.0, 0.0, 0.0]) == pytest.approx(2 * solution.P()[0])


@pytest.mark.parametrize(
    ("query", "reason"),
    [
        (quadratic_query("double-integrator-2d", cost={"state": None}), "cost.state"),
        (quadratic_query("double-integrator-2d", cost={"goal": 1.0}), "cost.goal"),
        (
            quadratic_query("double-integrator-2d", obstacles=(Obstacle.circle([2, 2], 1),)),
            "obstacles",
        ),
        (
            quadratic_query("double-integrator-1d", input_lower=(-1.0,), input_upper=(1.0,)),
            "bounded",
        ),
        (quadratic_query("rover", center=[1.0, 0.0]), "drift at the goal"),
        (
            Query("unicycle", Goal((0, 0), 0.1), cost=RunningCost(goal=0, state=((0.0,) * 3,) * 3)),
            "not linear",
        ),
    ],
)
def test_other_queries_are_refused_with_the_reason(query, reason):
    with pytest.raises(SolveError, match=reason) as caught:
        LinearQuadratic.of_query(query)
    assert caught.value.status is Status.NOT_APPLICABLE


# Bad input

GOOD = {"A": [[0, 1], [0, 0]], "B": [[0], [1]], "M": np.eye(2), "R": [[1.0]]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"A": [[0, 1]]}, "^A: must have shape"),
        ({"A": [[0, np.nan], [0, 0]]}, "^A: numbers must be finite"),
        ({"B": [0, 1]}, "^B: must be a matrix"),
        ({"B": [[0], [1], [2]]}, "^B: must have shape"),
        ({"M": [[1, 2], [0, 1]]}, "^M: must be symmetric"),
        ({"M": [[1, 0], [0, -1]]}, "^M: must be positive semidefinite"),
        ({"M": np.eye(3)}, "^M: must have shape"),
        ({"R": [[0.0]]}, "^R: must be positive definite"),
        ({"R": [[np.inf]]}, "^R: numbers must be finite"),
        ({"reference": [1.0]}, "^reference: must have shape"),
        ({"reference": [1.0, np.nan]}, "^reference: numbers must be finite"),
    ],
)
def test_bad_matrices_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        LinearQuadratic(**{**GOOD, **change})


def test_unreachable_unstable_mode_is_named():
    problem = LinearQuadratic(np.diag([-1.0, 2.0]), [[1], [0]], np.eye(2), [[1.0]])
    with pytest.raises(ValueError, match=r"not stabilisable.*eigenvalue 2"):
        algebraic_riccati(problem)
    stable = LinearQuadratic(np.diag([-1.0, -2.0]), [[1], [0]], np.eye(2), [[1.0]])
    assert algebraic_riccati(stable).P()[1, 1] == pytest.approx(0.25)


def test_unseen_marginal_mode_is_named():
    unseen = LinearQuadratic(GOOD["A"], GOOD["B"], np.diag([0.0, 1.0]), [[1.0]])
    with pytest.raises(ValueError, match=r"not detectable.*eigenvalue 0"):
        algebraic_riccati(unseen)


@pytest.mark.parametrize("horizon", [0.0, -1.0, np.inf, np.nan])
def test_bad_horizon(horizon):
    with pytest.raises(ValueError, match=r"^horizon: must be a positive"):
        differential_riccati(INTEGRATOR, np.eye(2), horizon)


@pytest.mark.parametrize("terminal", [np.eye(3), -np.eye(2), [[1, 2], [3, 4]]])
def test_bad_terminal(terminal):
    with pytest.raises(ValueError, match=r"^terminal: must"):
        differential_riccati(INTEGRATOR, terminal, 1.0)


@pytest.mark.parametrize("times", [-0.1, 2.1, [0.0, np.nan]])
def test_times_outside_the_horizon(times):
    solution = differential_riccati(INTEGRATOR, np.eye(2), 2.0)
    with pytest.raises(ValueError, match=r"^times: must lie in"):
        solution.P(times)
