"""The residual: zero for a true value, and it picks where a wrong one is worst."""

import numpy as np
from causality_free_problems import random_value

from learning.causality_free.families import get_family
from learning.causality_free.residual import largest, residuals
from ocp.cost import RunningCost
from ocp.query import Equilibrium, Query
from ocp.regulation import RegulatorValue


def double_integrator() -> Query:
    cost = RunningCost(goal=0.0, state=tuple(map(tuple, np.eye(2).tolist())))
    return Query("double-integrator-1d", Equilibrium((0.0, 0.0), 0.1), cost=cost)


def test_a_true_value_has_none() -> None:
    query = double_integrator()
    x = np.random.default_rng(0).uniform(-1, 1, (50, 2))
    assert residuals(query, RegulatorValue(query), x).max() < 1e-10


def test_the_residual_of_a_scaled_value_is_known() -> None:
    """With c V: u is c u*, so H = x'Mx (1 - c) + (c - c^2) u*'R u* and L = x'Mx + c^2 u*'R u*."""
    query = double_integrator()
    honest = RegulatorValue(query)
    c = 1.3

    class Scaled:
        def value(self, states):
            return c * honest.value(states)

        def gradient(self, states):
            return c * honest.gradient(states)

    x = np.random.default_rng(1).uniform(-1, 1, (20, 2))
    W = (x**2).sum(axis=1)
    effort = (honest.gradient(x)[:, 1] / 2) ** 2
    # H(cV) = W + c p'f0 - c^2 p'BB'p/4, and H(V) = 0 gives p'f0 = effort - W.
    H = W + c * (effort - W) - c**2 * effort
    L = W + c**2 * effort
    assert np.allclose(residuals(query, Scaled(), x), np.abs(H) / L, rtol=1e-9)


def test_sampling_picks_the_largest_residuals() -> None:
    family = get_family("car")
    value = random_value(family, 5)
    x = family.starts(value.query, 200, np.random.default_rng(2))
    picked = largest(value.query, value, x, 12)
    all_of_them = residuals(value.query, value, x)
    chosen = residuals(value.query, value, picked)
    assert np.allclose(chosen, np.sort(all_of_them)[::-1][:12], rtol=1e-9)
    assert all((x == row).all(axis=1).any() for row in picked)
