"""What the robot really does under piecewise-polynomial inputs: the check on a transcription.

A direct method ties the dynamics down at its nodes only. Here every interval is integrated again,
finely, from the state the method claims to its claimed next one; the gaps, weighted with the
costate, estimate by how much the claimed cost is wrong.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import int64, types
from numpy.typing import NDArray

from ocp.compiled.jit import KERNEL, MATRIX, SCALAR, VECTOR, compiled, float64
from ocp.kernels import kernels, parameters
from ocp.query import Query

Array = NDArray[np.float64]
CUBE = float64[:, :, ::1]

# Runge-Kutta 4 with step doubling. At a kink of the cost no step meets the accuracy; one of the
# smallest length is accepted, its error being of the order of that length squared.
ACCURACY = 1e-12  # of a step, relative
SMALLEST = 1e-7  # step, as a fraction of an interval
MAX_STEPS = 10_000


@dataclass(frozen=True)
class PiecewiseInput:
    """Inputs that are polynomials on each of `k` intervals, clipped to the query's bounds.

    Attributes:
        durations: `[k]`, seconds.
        coefficients: `[k, d, m]`, ascending powers of the fraction of the interval gone by.
    """

    durations: Array
    coefficients: Array


@dataclass(frozen=True)
class Replay:
    """Motions from each interval's start.

    Attributes:
        states: `[k, s + 1, n]`, at `s + 1` equispaced times of each interval.
        costs: `[k, s + 1]`, running cost accumulated since the interval's start.
        times: `[k, s + 1]`, seconds from the start of the first interval.
        accurate: whether the integration came to its end everywhere.
    """

    states: Array
    costs: Array
    times: Array
    accurate: bool


def replay(query: Query, inputs: PiecewiseInput, starts: Array, samples: int = 8) -> Replay:
    """Integrate every interval, interval i from `starts[i]`.

    Args:
        query: gives dynamics, running cost and input bounds.
        inputs: on `k` intervals.
        starts: `[k, n]`, or `[n]` for one motion through all intervals.
        samples: steps reported in each interval.
    """
    starts = np.asarray(starts, dtype=float)
    chained = starts.ndim == 1
    k = len(inputs.durations)
    given = np.array(np.broadcast_to(starts, (k, query.system.n)), order="C")
    states = np.zeros((k, samples + 1, query.system.n))
    costs = np.zeros((k, samples + 1))
    lower, upper = query.input_bounds
    compiled_query = kernels(query)
    failed = _replay(
        compiled_query.dynamics,
        compiled_query.running_cost,
        parameters(query),
        given,
        np.ascontiguousarray(inputs.durations, dtype=float),
        np.ascontiguousarray(inputs.coefficients, dtype=float),
        np.ascontiguousarray(np.stack([lower, upper])),
        int(chained),
        states,
        costs,
    )
    ends = np.cumsum(inputs.durations)
    fractions = np.linspace(0.0, 1.0, samples + 1)
    times = (ends - inputs.durations)[:, None] + inputs.durations[:, None] * fractions
    return Replay(states, costs, times, failed == 0)


@compiled(types.void(KERNEL, SCALAR, VECTOR, MATRIX, MATRIX, VECTOR, float64, float64, VECTOR))
def _rate(dynamics, running_cost, q, coefficients, bounds, state, fraction, duration, out):
    """d/d(fraction) of [x, cost]."""
    d, m = coefficients.shape
    n = state.shape[0] - 1
    xu = np.empty(n + m)
    xu[:n] = state[:n]
    for j in range(m):
        u = 0.0
        for i in range(d - 1, -1, -1):
            u = u * fraction + coefficients[i, j]
        xu[n + j] = min(max(u, bounds[0, j]), bounds[1, j])
    rate = np.empty(n)
    dynamics(xu[:n], xu[n:], rate)
    out[:n] = duration * rate
    out[n] = duration * running_cost(xu, q)


@compiled(
    types.void(
        *(KERNEL, SCALAR, VECTOR, MATRIX, MATRIX, VECTOR),
        *(float64, float64, float64, VECTOR),
    )
)
def _step(dynamics, running_cost, q, coefficients, bounds, state, t, h, duration, out):
    """One classical Runge-Kutta step of length `h` from fraction `t`."""
    size = state.shape[0]
    k1, k2, k3, k4 = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    m = t + h / 2
    _rate(dynamics, running_cost, q, coefficients, bounds, state, t, duration, k1)
    _rate(dynamics, running_cost, q, coefficients, bounds, state + h / 2 * k1, m, duration, k2)
    _rate(dynamics, running_cost, q, coefficients, bounds, state + h / 2 * k2, m, duration, k3)
    _rate(dynamics, running_cost, q, coefficients, bounds, state + h * k3, t + h, duration, k4)
    out[:] = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


@compiled(int64(KERNEL, SCALAR, VECTOR, MATRIX, VECTOR, CUBE, MATRIX, int64, CUBE, MATRIX))
def _replay(
    dynamics, running_cost, q, starts, durations, coefficients, bounds, chained, states, costs
):
    """Fill `states` and `costs`; the number of sample steps that were given up."""
    k, n = starts.shape
    samples = states.shape[1] - 1
    state, whole = np.empty(n + 1), np.empty(n + 1)
    half, both = np.empty(n + 1), np.empty(n + 1)
    failed = 0
    for interval in range(k):
        if chained == 0 or interval == 0:
            state[:n] = starts[interval]
        state[n] = 0.0
        states[interval, 0] = state[:n]
        costs[interval, 0] = 0.0
        u, duration = coefficients[interval], durations[interval]
        step = 0.5 / samples
        for s in range(samples):
            t, end = s / samples, (s + 1) / samples
            steps = 0
            while t < end:
                h = min(step, end - t)
                _step(dynamics, running_cost, q, u, bounds, state, t, h, duration, whole)
                _step(dynamics, running_cost, q, u, bounds, state, t, h / 2, duration, half)
                _step(dynamics, running_cost, q, u, bounds, half, t + h / 2, h / 2, duration, both)
                error = 0.0
                for i in range(n + 1):
                    error += abs(both[i] - whole[i]) / 15 / (1.0 + abs(both[i]))
                steps += 1
                if steps > MAX_STEPS or not math.isfinite(error):
                    failed += 1
                    break
                if error <= ACCURACY or h <= SMALLEST:
                    t = end if h == end - t else t + h
                    state[:] = both + (both - whole) / 15
                growth = 0.9 * (ACCURACY / max(error, 1e-30)) ** 0.2
                step = max(h * min(max(growth, 0.2), 4.0), SMALLEST)
            states[interval, s + 1] = state[:n]
            costs[interval, s + 1] = state[n]
    return failed
