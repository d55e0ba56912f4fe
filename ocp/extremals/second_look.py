"""An extremal looked at again, by what its solve did not use.

It is integrated forward from each node, where the solve went backward, and more accurately. Along
it the Hamiltonian is made from the definitions of dynamics and running cost, which the flow was
derived from.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numba import int64
from numpy.typing import NDArray

from ocp.compiled.function_address import ADDRESSES, addresses, function_at
from ocp.compiled.jit import KERNEL, MATRIX, SCALAR, VECTOR, compiled, float64
from ocp.extremals.hamiltonian_flow import (
    FINISHED,
    INTEGERS,
    PROPAGATE,
    flow_addresses,
    flow_layout,
)
from ocp.kernels import Kernels, kernels, parameters
from ocp.query import Query
from ocp.trajectory import Trajectory

Array = NDArray[np.float64]

kernel_at = function_at(KERNEL)
scalar_at = function_at(SCALAR)
propagate_at = function_at(PROPAGATE)


@dataclass(frozen=True)
class SecondLook:
    """What was found.

    Attributes:
        motion: at `samples` equal steps of each of N segments, with costates. Its cost is exact to
            second order in the gaps that are left at the nodes.
        gap: the largest distance from a node so reached to the solution's, relative to 1 + size;
            infinite if the integration failed.
        hamiltonians: `[k]` along the motion.
        costs: `[k]`, running cost along the motion.
    """

    motion: Trajectory
    gap: float
    hamiltonians: Array
    costs: Array


def look_again(
    query: Query, fractions: Array, nodes: Array, duration: float, samples: int, tolerance: float
) -> SecondLook:
    """Integrate again an extremal with `nodes` `[N + 1, 2n]` at `fractions` `[N + 1]`.

    Args:
        query: the query.
        fractions, nodes: as `shoot` leaves them, row 0 being the start.
        duration: seconds.
        samples: points in each segment.
        tolerance: of an integration step, relative to 1 + size.
    """
    n, count = query.system.n, samples * (len(fractions) - 1) + 1
    times, points = np.empty(count), np.empty((count, 2 * n + 1))
    inputs, hamiltonians, costs = (
        np.empty((count, query.system.m)),
        np.empty(count),
        np.empty(count),
    )
    gap = _trace(
        _addresses(kernels(query)), parameters(query), flow_layout(query), fractions, nodes,
        duration, samples, tolerance, times, points, inputs, hamiltonians, costs,
    )  # fmt: skip
    columns = points[:, :n].copy(), inputs, points[:, n:-1].copy(), points[:, -1].copy()
    return SecondLook(Trajectory(times, *columns), gap, hamiltonians, costs)


@cache
def _addresses(k: Kernels) -> NDArray[np.intp]:
    own = addresses([k.optimal_input, k.dynamics, k.running_cost])
    return np.concatenate([flow_addresses(k), own])


@compiled(
    float64(
        ADDRESSES, VECTOR, INTEGERS, VECTOR, MATRIX, float64, int64, float64,
        VECTOR, MATRIX, MATRIX, VECTOR, VECTOR,
    )
)  # fmt: skip
def _trace(
    functions, q, layout, fractions, nodes, duration, samples, tolerance,
    times, points, inputs, hamiltonians, costs,
):  # fmt: skip
    """Fills the last five; returns the gap."""
    n, m = layout[0], layout[1]
    count = fractions.shape[0] - 1
    integrate = propagate_at(functions[3, 0], functions[3, 1])
    none, no_record, no_tangents = np.empty(0), np.empty((0, 0)), np.empty((2 * n, 0))
    y, pace = np.zeros(2 * n + 1), np.zeros(1)
    worst = 0.0
    for k in range(count):
        y[: 2 * n] = nodes[k]
        step = (fractions[k + 1] - fractions[k]) * duration / samples
        for s in range(samples):
            times[k * samples + s] = fractions[k] * duration + s * step
            points[k * samples + s] = y
            ended = integrate(
                functions, q, layout, y, no_tangents, step, tolerance, pace, none, no_record
            )
            if ended != FINISHED:
                return np.inf
        for i in range(2 * n):
            worst = max(worst, abs(y[i] - nodes[k + 1, i]) / (1.0 + abs(y[i])))
        for i in range(n):  # where the next segment begins elsewhere, the difference is worth p
            y[2 * n] += nodes[k + 1, n + i] * (y[i] - nodes[k + 1, i])
    points[count * samples, : 2 * n] = nodes[count]
    points[count * samples, 2 * n] = y[2 * n]
    times[count * samples] = duration

    optimal_input = kernel_at(functions[4, 0], functions[4, 1])
    dynamics = kernel_at(functions[5, 0], functions[5, 1])
    running_cost = scalar_at(functions[6, 0], functions[6, 1])
    xu, rate = np.empty(n + m), np.empty(n)
    for k in range(points.shape[0]):
        optimal_input(points[k], q, inputs[k])
        xu[:n] = points[k, :n]
        xu[n:] = inputs[k]
        dynamics(xu[:n], inputs[k], rate)
        costs[k] = running_cost(xu, q)
        hamiltonians[k] = costs[k]
        for i in range(n):
            hamiltonians[k] += points[k, n + i] * rate[i]
    return worst
