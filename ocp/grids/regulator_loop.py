"""What the linear regulator really costs, from many states at once: an upper bound of V.

Near an equilibrium V is a narrow valley: x'P x may rise a hundred times faster across than along.
A grid's multilinear interpolation adds about V'' h^2 / 8 in every step of about one cell, so the
error of V is of first order in the cell, large where the valley is narrow, and is carried to all
motions that pass through it, which is all of them. The regulator's own closed loop has no such
error; where it works at all, it is a bound that the scheme may start from.
"""

from functools import cache

import numpy as np
from numba import types
from numpy.typing import NDArray

from ocp.compiled.function_address import ADDRESSES, addresses, function_at
from ocp.compiled.jit import KERNEL, MATRIX, SCALAR, VECTOR, compiled, float64
from ocp.grid import Grid
from ocp.kernels import Kernels, kernels, parameters
from ocp.query import Query
from ocp.regulation import RegulatorValue, regulator

STEP = 0.01  # seconds, of Runge and Kutta's classical method
TAIL = 1e-4  # share of the cost that x'P x may make up at the end
LIFETIMES = 12.0  # of the closed loop's slowest mode: longer motions count as not arriving
LONGEST = 20.0  # seconds

kernel_at = function_at(KERNEL)
scalar_at = function_at(SCALAR)


def regulator_costs(query: Query, grid: Grid) -> NDArray[np.float64]:
    """Cost `[*grid.shape]` of the regulator's closed loop from each node, its inputs bounded.

    Infinite where it does not come to rest within the grid's box; and everywhere if there are hard
    obstacles, which it knows nothing of.
    """
    nodes = np.ascontiguousarray(grid.nodes().reshape(-1, grid.dimension))
    costs = np.full(len(nodes), np.inf)
    if not query.hard_obstacles:
        free = ~np.array(grid.periodic)
        box = np.array([np.where(free, grid.lower, -np.inf), np.where(free, grid.upper, np.inf)])
        P = np.ascontiguousarray(RegulatorValue(query).P)
        seconds = min(LIFETIMES / regulator(query).decay_rate, LONGEST)
        _loops(
            _addresses(kernels(query)), parameters(query), P, query.reference,
             query.system.period, box, query.system.m, STEP, int(seconds / STEP),
            nodes, costs,
        )  # fmt: skip
    return costs.reshape(grid.shape)


@cache
def _addresses(k: Kernels) -> NDArray[np.intp]:
    return addresses([k.optimal_input, k.dynamics, k.running_cost])


@compiled(float64(MATRIX, VECTOR, VECTOR, VECTOR, VECTOR))
def _quadratic(P, centre, period, x, gradient):
    """x'P x, and its gradient 2 P x, from the equilibrium, the short way round."""
    n = x.shape[0]
    total = 0.0
    gradient[:] = 0.0
    for i in range(n):
        a = x[i] - centre[i]
        if period[i] > 0.0:
            a -= period[i] * np.round(a / period[i])
        for j in range(n):
            gradient[j] += 2.0 * P[j, i] * a
    for i in range(n):
        a = x[i] - centre[i]
        if period[i] > 0.0:
            a -= period[i] * np.round(a / period[i])
        total += 0.5 * a * gradient[i]
    return total


@compiled(
    types.void(
        ADDRESSES, VECTOR, MATRIX, VECTOR, VECTOR, MATRIX, types.int64, float64, types.int64,
        MATRIX, VECTOR,
    )
)  # fmt: skip
def _loops(functions, q, P, centre, period, box, inputs, step, most, nodes, costs):
    """Fills `costs` where the loop arrives; `inputs` is m."""
    optimal_input = kernel_at(functions[0, 0], functions[0, 1])
    dynamics = kernel_at(functions[1, 0], functions[1, 1])
    running_cost = scalar_at(functions[2, 0], functions[2, 1])
    n, m = nodes.shape[1], inputs
    x, z, xu = np.empty(n), np.empty(2 * n), np.empty(n + m)
    slopes = np.empty((4, n + 1))
    for row in range(nodes.shape[0]):
        x[:] = nodes[row]
        spent = 0.0
        for _ in range(most):
            left = _quadratic(P, centre, period, x, z[n:])
            if left <= TAIL * spent:
                costs[row] = spent + left
                break
            z[:n] = x
            optimal_input(z, q, xu[n:])  # held for the step: a motion that the robot can do
            inside = True
            for stage in range(4):
                ahead = 0.0 if stage == 0 else (step if stage == 3 else 0.5 * step)
                for i in range(n):
                    z[i] = x[i] + (ahead * slopes[stage - 1, i] if stage > 0 else 0.0)
                    inside = inside and box[0, i] <= z[i] <= box[1, i]
                xu[:n] = z[:n]
                dynamics(xu[:n], xu[n:], slopes[stage, :n])
                slopes[stage, n] = running_cost(xu, q)
            if not inside:
                break
            for i in range(n + 1):
                change = slopes[0, i] + 2.0 * (slopes[1, i] + slopes[2, i]) + slopes[3, i]
                if i < n:
                    x[i] += step / 6.0 * change
                else:
                    spent += step / 6.0 * change
