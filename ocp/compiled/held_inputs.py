"""Many robots, each with its own query, advanced by Runge-Kutta steps under held inputs."""

import numpy as np
from numba import boolean, int64, types
from numpy.typing import NDArray

from ocp.compiled.jit import KERNEL, MATRIX, SCALAR, VECTOR, compiled, float64
from ocp.kernels import Layout, kernels, parameters
from ocp.query import Query


def parameter_row(query: Query, obstacles: int) -> NDArray[np.float64]:
    """`[p]`: the parameters of a query, padded by zeros to the length for so many obstacles.

    Raises:
        ValueError: if the query has more.
    """
    layout, row = Layout.of(query), parameters(query)
    if len(query.obstacles) > obstacles:
        raise ValueError(f"obstacle: there is room for {obstacles}, got {len(query.obstacles)}")
    padded = np.zeros(layout.count + 1 + obstacles * layout.stride)
    padded[: len(row)] = row
    return padded


def state_costs(
    query: Query, rows: NDArray[np.float64], states: NDArray[np.float64]
) -> NDArray[np.float64]:
    """W `[k]` of each query's `rows` `[k, p]` at `states` `[k, n]`; `query` is any of them."""
    out = np.empty(len(states))
    _state_costs(kernels(query).state_cost, rows, states, out)
    return out


def advance(
    query: Query,
    rows: NDArray[np.float64],
    states: NDArray[np.float64],
    inputs: NDArray[np.float64],
    step: float,
    substeps: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """States after `substeps` steps of `step` seconds, their running costs, and who arrived.

    A robot that ends a step in its goal ball stands still from there on.

    Args:
        query: any of the queries: it gives the robot and the form of the cost.
        rows: `[k, p]`, see `parameter_row`.
        states: `[k, n]`.
        inputs: `[k, m]`.
        step: seconds.
        substeps: how many.

    Returns:
        `[k, n]`, `[k]` and `[k]`.
    """
    compiled_kernels, layout = kernels(query), Layout.of(query)
    moved = np.array(states, dtype=float)
    costs, arrived = np.zeros(len(moved)), np.zeros(len(moved), dtype=np.bool_)
    _advance(
        compiled_kernels.dynamics,
        compiled_kernels.running_cost,
        rows,
        np.array(inputs, dtype=float),
        layout.goal,
        np.array(query.system.position),
        step,
        substeps,
        moved,
        costs,
        arrived,
    )
    return moved, costs, arrived


@compiled(types.void(SCALAR, MATRIX, MATRIX, VECTOR))
def _state_costs(cost, rows, states, out):
    for row in range(states.shape[0]):
        out[row] = cost(states[row], rows[row])


@compiled(
    types.void(
        KERNEL,
        SCALAR,
        MATRIX,
        MATRIX,
        int64,
        int64[::1],
        float64,
        int64,
        MATRIX,
        float64[::1],
        boolean[::1],
    )
)
def _advance(dynamics, cost, rows, inputs, goal, position, step, substeps, states, costs, arrived):
    n, m, d = states.shape[1], inputs.shape[1], position.shape[0]
    rate, mean, xu = np.empty(n), np.empty(n), np.empty(n + m)
    for row in range(states.shape[0]):
        x, q = states[row], rows[row]
        xu[n:] = inputs[row]
        for _ in range(substeps):
            mean[:], rate[:] = 0.0, 0.0
            total = 0.0
            for stage in range(4):
                share = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
                weight = 1.0 / 3.0 if stage == 1 or stage == 2 else 1.0 / 6.0
                xu[:n] = x + share * step * rate
                dynamics(xu[:n], xu[n:], rate)
                mean += weight * rate
                total += weight * cost(xu, q)
            x += step * mean
            costs[row] += step * total
            squared = 0.0
            for i in range(d):
                squared += (x[position[i]] - q[goal + i]) ** 2
            if squared <= q[goal + d] ** 2:
                arrived[row] = True
                break
