"""The Hamilton-Jacobi residual of a value: where it is wrong, without knowing the right one."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.batch import minimised_hamiltonians, optimal_inputs, running_costs
from ocp.query import Query
from ocp.value import Value

Array = NDArray[np.float64]


def residuals(query: Query, value: Value, states: ArrayLike) -> Array:
    """|min_u H(x, u, grad V)| / L(x, u*) `[...]` at states `[..., n]`.

    Along the greedy motion V falls at the rate L - H: the residual is the share of the running
    cost by which V's promise is off. It is 0 where V solves the Hamilton-Jacobi-Bellman equation.
    """
    states = np.asarray(states, dtype=float)
    costates = value.gradient(states)
    rate = running_costs(query, states, optimal_inputs(query, states, costates))
    return np.abs(minimised_hamiltonians(query, states, costates)) / np.maximum(rate, 1e-12)


def largest(query: Query, value: Value, candidates: Array, count: int) -> Array:
    """The `count` candidates `[k, n]` with the largest residuals, largest first, `[count, n]`."""
    order = np.argsort(-residuals(query, value, candidates), kind="stable")
    return candidates[order[:count]]
