"""Over random systems: what is declared learned is learned."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plants_for_learning import held_motion, optimal_gains

from learning.q_learning.certificate import relative_gain_error
from learning.q_learning.learner import LearnerSettings, QLearner
from learning.q_learning.quadratic_cost import QuadraticCost

PERIOD, SUBSTEPS = 0.01, 4

declared: list[bool] = []


def controllability(A: np.ndarray, B: np.ndarray) -> float:
    """Least over largest singular value of [B, AB, ..., A^(n-1) B]."""
    blocks = [B]
    for _ in range(len(A) - 1):
        blocks.append(A @ blocks[-1])
    values = np.linalg.svd(np.hstack(blocks), compute_uv=False)
    return values[-1] / values[0]


@settings(max_examples=200)
@given(
    seed=st.integers(0, 10**9),
    n=st.integers(1, 4),
    m=st.integers(1, 3),
    noise=st.sampled_from([0.0, 0.0, 1e-5, 1e-3]),
    spare=st.floats(1.5, 3.0),
)
def claim_is_honest(seed, n, m, noise, spare):
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(n, n)) / np.sqrt(n), rng.normal(size=(n, m))
    assert controllability(A, B) > 0
    root = rng.normal(size=(n, n))
    cost = QuadraticCost(root @ root.T, np.diag(rng.uniform(0.5, 2.0, m)), np.eye(n), 3.0)
    holds = int(spare * (n * (n + 1) // 2 + m * n)) + 5
    inputs = rng.normal(size=(holds, m))
    states = held_motion(A, B, rng.normal(size=n), PERIOD, SUBSTEPS, inputs)
    states = states + noise * rng.normal(size=states.shape)
    learner = QLearner(cost, LearnerSettings(sample_period=PERIOD, substeps=SUBSTEPS))
    learner.absorb(states, inputs)
    certificate = learner.certify()
    full = certificate.excitation.rank == certificate.excitation.required_rank
    if noise == 0 and full:
        declared.append(certificate.holds)
    if certificate.holds:
        times = np.linspace(0.0, cost.horizon, 16)
        exact = optimal_gains(A, B, cost.M, cost.R, cost.terminal, cost.horizon, times)
        error = relative_gain_error(learner.learned().gain(times), exact)
        assert error <= 10 * certificate.gain_error


def test_no_random_system_is_declared_learned_beyond_ten_times_the_claim():
    declared.clear()
    claim_is_honest()
    assert len(declared) >= 50
    assert np.mean(declared) >= 0.95


@pytest.mark.parametrize("m", [1, 2])
def test_a_mode_that_never_moves_is_missing_from_the_rank(m):
    """Uncontrollable and at rest: no data can tell its dynamics."""
    A = np.diag([-1.0, -0.5, 0.3])
    B = np.vstack([np.eye(2)[:, :m], np.zeros((1, m))])
    cost = QuadraticCost(np.eye(3), np.eye(m), np.eye(3), 2.0)
    inputs = np.random.default_rng(0).normal(size=(100, m))
    learner = QLearner(cost)
    learner.absorb(held_motion(A, B, [1.0, -1.0, 0.0], PERIOD, SUBSTEPS, inputs), inputs)
    certificate = learner.certify()
    assert certificate.excitation.rank < certificate.excitation.required_rank
    assert not certificate.holds
    assert "rank" in certificate.reason
