"""Laws of the value that hold whatever the weights: consistent with the regulator, a gradient."""

import numpy as np
import pytest
from causality_free_problems import random_value
from hypothesis import given, settings
from hypothesis import strategies as st

from learning.causality_free.families import FAMILIES
from ocp.compiled.batch import rates
from ocp.regulation import regulator
from ocp.value import greedy

EVERY = pytest.mark.parametrize("family", FAMILIES.values(), ids=list(FAMILIES))
SEEDS = st.integers(0, 10_000)
"""Of random networks, their last layer up to a few times what training ends in."""


@EVERY
@settings(max_examples=15)
@given(seed=SEEDS, size=st.floats(0.0, 2.0))
def test_value_and_gradient_vanish_at_the_equilibrium(family, seed, size) -> None:
    value = random_value(family, seed, size)
    assert value.value(value.query.reference) == 0.0
    assert np.array_equal(value.gradient(value.query.reference), np.zeros(len(family.reach)))


@EVERY
@settings(max_examples=15)
@given(seed=SEEDS, size=st.floats(0.0, 2.0))
def test_the_second_derivative_is_the_regulators(family, seed, size) -> None:
    """2 P to 1e-8: the odd part of the gradient's differences over h, extrapolated to h = 0."""
    value = random_value(family, seed, size)
    x_g, P = value.query.reference, regulator(value.query).matrix

    def difference(h: float) -> np.ndarray:
        shifts = h * np.eye(len(x_g))
        return (value.gradient(x_g + shifts) - value.gradient(x_g - shifts)) / (2 * h)

    h = 1e-3  # the error goes with h^2, then with h^4, then with h^6
    once = [(4 * difference(h / 2**k / 2) - difference(h / 2**k)) / 3 for k in (0, 1)]
    found = (16 * once[1] - once[0]) / 15
    assert np.abs(found - 2 * P).max() <= 1e-8 * np.abs(P).max()


@EVERY
@settings(max_examples=10)
@given(seed=SEEDS)
def test_the_gradient_is_the_values(family, seed) -> None:
    value = random_value(family, seed)
    rng = np.random.default_rng(seed)
    x = family.starts(value.query, 8, rng)
    h = 1e-5
    for i in range(x.shape[1]):
        step = np.zeros(x.shape[1])
        step[i] = h
        slope = (value.value(x + step) - value.value(x - step)) / (2 * h)
        size = np.abs(value.gradient(x)).max()
        assert np.allclose(slope, value.gradient(x)[:, i], rtol=1e-6, atol=1e-7 * size)


@EVERY
@settings(max_examples=15)
@given(seed=SEEDS, size=st.floats(0.0, 2.0))
def test_the_closed_loop_is_locally_stable_for_any_weights(family, seed, size) -> None:
    """Its linearisation is the linear regulator's closed loop, so it has its decay rate."""
    value = random_value(family, seed, size)
    query = value.query
    policy, x_g = greedy(query, value), query.reference

    def rate(x: np.ndarray) -> np.ndarray:
        return rates(query, x, policy(x))

    h = 1e-4
    shifts = h * np.eye(len(x_g))
    coarse = (rate(x_g + shifts) - rate(x_g - shifts)).T / (2 * h)
    fine = (rate(x_g + shifts / 2) - rate(x_g - shifts / 2)).T / h
    loop = (4 * fine - coarse) / 3
    lq = regulator(query).problem
    expected = lq.A - lq.B @ regulator(query).gain()
    assert np.abs(loop - expected).max() < 1e-5 * np.abs(expected).max()
    assert np.linalg.eigvals(loop).real.max() < -0.99 * regulator(query).decay_rate


@EVERY
def test_the_value_is_positive_and_takes_any_leading_axes(family) -> None:
    value = random_value(family, 3)
    x = family.starts(value.query, 12, np.random.default_rng(0))
    assert (value.value(x) > 0).all()
    folded = x.reshape(3, 4, -1)
    assert np.array_equal(value.value(folded), value.value(x).reshape(3, 4))
    assert np.array_equal(value.gradient(folded), value.gradient(x).reshape(folded.shape))
    assert np.allclose(value.value(x[0]), value.value(x)[0], rtol=1e-13)


@EVERY
def test_the_last_layers_features_give_value_and_slope(family) -> None:
    """What adaptation is linear in: log V = log V_LQR + w'(phi - phi_g), and its derivative."""
    value = random_value(family, 4)
    x = family.starts(value.query, 10, np.random.default_rng(1))
    phi, slopes = value.last_features(x)
    w = value.weights.last.numpy()
    e = value.query.system.difference(x, value.query.reference)
    quadratic = np.einsum("ki,ij,kj->k", e, value.P, e)
    V = value.value(x)
    assert np.allclose(np.log(V / quadratic), phi @ w, rtol=1e-10, atol=1e-12)
    by_log = 2 * (e @ value.P) / quadratic[:, None] + slopes @ w
    assert np.allclose(V[:, None] * by_log, value.gradient(x), rtol=1e-9, atol=1e-9)
