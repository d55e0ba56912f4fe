"""From a guess to the first iterate of multiple shooting: its costates, and its nodes."""

from dataclasses import replace
from functools import cache

import numpy as np
from numba import types
from numpy.typing import NDArray

from ocp.compiled.function_address import ADDRESSES, addresses, function_at
from ocp.compiled.jit import KERNEL, KERNEL_WITH_JACOBIAN, MATRIX, VECTOR, compiled
from ocp.extremals.newton_step import SOLVE, solve
from ocp.kernels import Kernels, kernels, parameters
from ocp.query import Query
from ocp.trajectory import Trajectory

Array = NDArray[np.float64]

DIFFERENCE = 1e-6  # between states, relative to 1 + size: a guess needs no exact Jacobian

kernel_at = function_at(KERNEL)
derivatives_at = function_at(KERNEL_WITH_JACOBIAN)
solve_at = function_at(SOLVE)


def with_costates(query: Query, guess: Trajectory) -> Trajectory:
    """`guess`, with costates from the adjoint equation p' = -dH/dx if it has none: from p = 0 back.

    Inputs of a guess may jump: the later node's belong to the interval (see `guess.py`).
    """
    if guess.costates is not None:
        return guess
    costates = np.zeros(guess.states.shape)
    _adjoint(
        _addresses(kernels(query)), parameters(query), _contiguous(guess.times),
        _contiguous(guess.states), _contiguous(guess.inputs), costates,
    )  # fmt: skip
    return replace(guess, costates=costates)


def first_nodes(guess: Trajectory, segments: int) -> tuple[Array, Array]:
    """Fractions of the duration `[N + 1]` and z = [x, p] there `[N + 1, 2n]`.

    Segments share out time, and the change of z along the guess (with costates), equally.
    """
    assert guess.costates is not None
    z = np.concatenate([guess.states, guess.costates], axis=1)
    fractions, nodes = np.empty(segments + 1), np.empty((segments + 1, z.shape[1]))
    _share(_contiguous(guess.times), z, fractions, nodes)
    return fractions, nodes


def _contiguous(array: Array) -> Array:
    return np.require(array, dtype=float, requirements=["C", "W"])


@cache
def _addresses(k: Kernels) -> NDArray[np.intp]:
    return addresses([k.dynamics, k.state_cost_derivatives, solve])


@compiled(types.void(ADDRESSES, VECTOR, VECTOR, MATRIX, MATRIX, MATRIX))
def _adjoint(functions, q, times, states, inputs, costates):
    """Fills all of `costates` `[k, n]` but the last row, which is given."""
    n = states.shape[1]
    dynamics = kernel_at(functions[0, 0], functions[0, 1])
    derivatives = derivatives_at(functions[1, 0], functions[1, 1])
    solved = solve_at(functions[2, 0], functions[2, 1])
    middle, slope, ahead, behind = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    hessian, matrix, pull = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    for k in range(states.shape[0] - 2, -1, -1):
        half = (times[k + 1] - times[k]) / 2
        for i in range(n):
            middle[i] = (states[k, i] + states[k + 1, i]) / 2
        derivatives(middle, q, slope, hessian)
        for j in range(n):
            x = middle[j]
            apart = DIFFERENCE * (1.0 + abs(x))
            middle[j] = x + apart
            dynamics(middle, inputs[k + 1], ahead)
            middle[j] = x - apart
            dynamics(middle, inputs[k + 1], behind)
            middle[j] = x
            for i in range(n):
                pull[j, i] = half * (ahead[i] - behind[i]) / (2 * apart)
        # The implicit midpoint rule, which stays bounded on long intervals.
        here, there = costates[k], costates[k + 1]
        for j in range(n):
            here[j] = there[j] + 2 * half * slope[j]
            for i in range(n):
                here[j] += pull[j, i] * there[i]
                matrix[j, i] = (1.0 if i == j else 0.0) - pull[j, i]
        if not solved(matrix, here):
            here[:] = there  # a guess need satisfy nothing


@compiled(types.void(VECTOR, MATRIX, VECTOR, MATRIX))
def _share(times, z, fractions, nodes):
    count, segments = times.shape[0], fractions.shape[0] - 1
    first, duration = times[0], times[count - 1] - times[0]
    mesh = np.zeros(count)
    moved = 0.0
    for k in range(1, count):
        for i in range(z.shape[1]):
            mesh[k] += abs(z[k, i] - z[k - 1, i])
        moved += mesh[k]
    for k in range(1, count):
        mesh[k] = mesh[k - 1] + mesh[k] / max(moved, 1e-300) + (times[k] - times[k - 1]) / duration
    row = 1
    for segment in range(segments + 1):
        wanted = mesh[count - 1] * segment / segments
        while row < count - 1 and mesh[row] < wanted:
            row += 1
        part = min((wanted - mesh[row - 1]) / (mesh[row] - mesh[row - 1]), 1.0)
        time = times[row - 1] + part * (times[row] - times[row - 1])
        fractions[segment] = (time - first) / duration
        for i in range(z.shape[1]):
            nodes[segment, i] = z[row - 1, i] + part * (z[row, i] - z[row - 1, i])
    fractions[0], fractions[segments] = 0.0, 1.0
