"""The sweep through the exact map is the Riccati solution; Lemma 4.1 holds on it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plants_for_learning import exact_map, optimal_gains

from learning.q_learning.learned_regulator import coefficients_of, matrices, solve_backward
from learning.q_learning.quadratic_cost import QuadraticCost
from ocp.trajectory import SolveError, Status


def random_plant(seed: int):
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 5)), int(rng.integers(1, 3))
    root = rng.normal(size=(n, n))
    cost = QuadraticCost(root @ root.T, np.diag(rng.uniform(0.5, 2.0, m)), np.eye(n), 3.0)
    return rng.normal(size=(n, n)), rng.normal(size=(n, m)), cost


@settings(max_examples=25)
@given(st.integers(0, 10**6))
def test_the_exact_map_gives_the_optimal_gain(seed):
    A, B, cost = random_plant(seed)
    times = np.linspace(0.0, cost.horizon, 7)
    exact = optimal_gains(A, B, cost.M, cost.R, cost.terminal, cost.horizon, times)
    learned = solve_backward(cost, exact_map(A, B), affine=False)
    assert learned.gain(times) == pytest.approx(exact, abs=1e-8 * (1 + np.abs(exact).max()))
    assert learned.P(cost.horizon) == pytest.approx(cost.terminal, abs=1e-14)
    assert not learned.offset(times).any()


@settings(max_examples=25)
@given(st.integers(0, 10**6))
def test_the_q_function_at_its_minimiser_is_the_value(seed):
    """Lemma 4.1, and each block against its definition in (13)."""
    A, B, cost = random_plant(seed)
    learned = solve_backward(cost, exact_map(A, B), affine=False)
    rng = np.random.default_rng(seed)
    times = np.linspace(0.0, 0.95 * cost.horizon, 5)
    x = rng.normal(size=(5, cost.n))
    q = learned.q_function(times)
    u = learned.input(x, times)
    scale = 1 + np.abs(learned.P(times)).max()
    assert q.gain() == pytest.approx(learned.gain(times), rel=1e-12)
    assert q.value(x, u) == pytest.approx(
        learned.value(x, times), abs=1e-7 * scale * (x @ x.T).max()
    )
    other = u + rng.normal(size=u.shape)
    excess = np.einsum("ki,ij,kj->k", other - u, cost.R, other - u)
    assert q.value(x, other) - q.value(x, u) == pytest.approx(excess, abs=1e-8 * scale**2)
    P = learned.P(times)
    step = 1e-4
    rate = (learned.P(times + step) - learned.P(times - step))[1:] / (2 * step)
    blocks = rate + P[1:] + cost.M + P[1:] @ A + A.T @ P[1:]
    assert q.xx[1:] == pytest.approx(blocks, abs=1e-4 * scale**3)
    assert q.ux == pytest.approx(B.T @ P, abs=1e-10 * scale)


def test_the_sweep_takes_more_nodes_for_more_accuracy():
    A, B, cost = random_plant(3)
    times = np.linspace(0.0, cost.horizon, 9)
    exact = optimal_gains(A, B, cost.M, cost.R, cost.terminal, cost.horizon, times)
    coarse = solve_backward(cost, exact_map(A, B), False, tolerance=1e-5)
    fine = solve_backward(cost, exact_map(A, B), False, tolerance=1e-11)
    assert len(fine.times) > 3 * len(coarse.times)
    errors = [np.abs(s.gain(times) - exact).max() for s in (coarse, fine)]
    assert errors[0] < 1e-2
    assert errors[1] < 1e-8
    assert errors[1] < errors[0]


def test_a_map_of_no_plant_is_reported():
    _, _, cost = random_plant(5)
    q = cost.n * (cost.n + 1) // 2
    rng = np.random.default_rng(0)
    wild = 50 * rng.normal(size=(q + cost.n * cost.m, q))
    with pytest.raises(SolveError) as caught:
        solve_backward(cost, wild, affine=False)
    assert caught.value.status is Status.NOT_CONVERGED


def test_coefficients_and_matrices_are_inverse():
    P = np.array([[2.0, 0.3, -1.0], [0.3, 1.0, 0.5], [-1.0, 0.5, 4.0]])
    x = np.array([1.0, -2.0, 0.5])
    products = [x[i] * x[j] for i in range(3) for j in range(i, 3)]
    assert coefficients_of(P) @ products == pytest.approx(x @ P @ x)
    assert np.array_equal(matrices(coefficients_of(P), 3), P)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"R": [[1.0, 0], [0, -1]]}, "^R: must be positive definite"),
        ({"M": [[1.0, 2], [0, 1]]}, "^M: must be symmetric"),
        ({"terminal": -np.eye(2)}, "^terminal: must be positive semidefinite"),
        ({"terminal": np.eye(3)}, "^terminal: must have shape"),
        ({"terminal": [[np.nan, 0], [0, 1]]}, "^terminal: numbers must be finite"),
        ({"horizon": 0.0}, "^horizon: must be a positive"),
        ({"horizon": np.inf}, "^horizon: must be a positive"),
    ],
)
def test_bad_costs_are_named(change, message):
    good = {"M": np.eye(2), "R": np.eye(1), "terminal": np.eye(2), "horizon": 1.0}
    with pytest.raises(ValueError, match=message):
        QuadraticCost(**{**good, **change})
