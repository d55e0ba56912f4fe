"""Fixed time: linear robots against Riccati, nonlinear ones against collocation."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

from ocp.collocation import solve_collocation
from ocp.cost import RunningCost
from ocp.extremals.fixed_time import solve_fixed_time
from ocp.models.linear import linear_system
from ocp.query import Goal, Query
from ocp.query_family import paper_query
from ocp.system import Coordinate, Input, System


def riccati(A, B, M, R, terminal, horizon) -> np.ndarray:
    """P(0) of -P' = A'P + PA - P B R^-1 B' P + M by an independent integrator."""
    n = len(A)

    def rate(_: float, flat: np.ndarray) -> np.ndarray:
        P = flat.reshape(n, n)
        return (A.T @ P + P @ A - P @ B @ np.linalg.solve(R, B.T) @ P + M).ravel()

    return solve_ivp(
        rate, (0, horizon), terminal.ravel(), method="DOP853", rtol=1e-12, atol=1e-12
    ).y[:, -1].reshape(n, n)  # fmt: skip


def random_system(n: int, m: int) -> tuple[System, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(n)
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    coordinates = tuple(Coordinate(f"x{i}", "1", -5.0, 5.0) for i in range(n))
    inputs = tuple(Input(f"u{i}", "1") for i in range(m))
    return linear_system(f"random-{n}", A, B, coordinates, inputs, (0,)), A, B


def quadratic_query(model: str | System, d: int, M: np.ndarray, R: np.ndarray) -> Query:
    rows = tuple(tuple(map(float, row)) for row in M)
    cost = RunningCost(input=tuple(map(float, R)), goal=0.0, state=rows)
    return Query(model, Goal((0.0,) * d, 0.5), (), cost)


def semidefinite(rng: np.random.Generator, n: int) -> np.ndarray:
    root = rng.normal(size=(n, n))
    return (root @ root.T + (root @ root.T).T) / 2


@pytest.mark.parametrize("horizon", [0.5, 5.0, 30.0])
@pytest.mark.parametrize("n", [2, 4])
def test_random_linear_systems_against_riccati(n: int, horizon: float) -> None:
    """V = x' P(0) x and its Hessian 2 P(0); the open-loop plants are unstable."""
    system, A, B = random_system(n, 2)
    assert np.linalg.eigvals(A).real.max() > 0
    rng = np.random.default_rng(7)
    M, terminal, R = semidefinite(rng, n), semidefinite(rng, n), rng.uniform(0.5, 2, 2)
    start = rng.uniform(-3, 3, n)
    motion = solve_fixed_time(quadratic_query(system, 1, M, R), start, horizon, terminal)
    P = riccati(A, B, M, np.diag(R), terminal, horizon)
    assert motion.value == pytest.approx(start @ P @ start, rel=1e-9)
    assert_allclose(motion.hessian / 2, P, rtol=1e-7, atol=1e-7 * np.abs(P).max())
    assert motion.trajectory.duration == pytest.approx(horizon)
    assert motion.trajectory.costates is not None
    assert_allclose(motion.trajectory.costates[0], 2 * P @ start, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_double_integrators_against_riccati(d: int) -> None:
    zero, identity = np.zeros((d, d)), np.eye(d)
    A = np.block([[zero, identity], [zero, zero]])
    B = np.vstack([zero, identity])
    M, terminal, R = np.diag(np.linspace(0.5, 2, 2 * d)), 3 * np.eye(2 * d), np.full(d, 0.7)
    start = np.linspace(-2, 2, 2 * d)
    query = quadratic_query(f"double-integrator-{d}d", d, M, R)
    motion = solve_fixed_time(query, start, 4.0, terminal)
    P = riccati(A, B, M, np.diag(R), terminal, 4.0)
    assert motion.value == pytest.approx(start @ P @ start, rel=1e-10)


def test_an_obstacle_course_agrees_with_collocation() -> None:
    """So short that the motion ends before the goal, at whose boundary IPOPT meets a kink."""
    query = paper_query((1.0, 1.0))
    terminal = np.diag([5.0, 5.0, 0.0])
    start = np.array([-3.0, -2.0, 0.3])
    motion = solve_fixed_time(query, start, 1.5, terminal)
    direct = solve_collocation(query, start, motion.trajectory, horizon=1.5, terminal_cost=terminal)
    assert (query.goal_distance(motion.trajectory.states) > 0).all()
    offset = direct.states[-1] - query.reference
    assert motion.value == pytest.approx(direct.cost + offset @ terminal @ offset, rel=1e-5)


def test_bad_arguments_are_refused() -> None:
    query = paper_query((1.0, 1.0))
    start = [-3.0, -2.0, 0.3]
    with pytest.raises(ValueError, match="horizon"):
        solve_fixed_time(query, start, 0.0)
    with pytest.raises(ValueError, match="semidefinite"):
        solve_fixed_time(query, start, 1.0, -np.eye(3))
    with pytest.raises(ValueError, match="symmetric"):
        solve_fixed_time(query, start, 1.0, [[1.0, 2.0], [0.0, 1.0]])
