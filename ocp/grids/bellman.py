"""The discrete Bellman equation at one state: V(x) = min_u [cost of a step + V(its end)].

A step holds its input until it has moved by a set number of cells along some axis of the grid, or
until it enters the goal ball (first hit). Shared by the lookahead policy and by value iteration.
"""

import math
from functools import cache
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from ocp.compiled.function_address import ADDRESSES, addresses, function_at
from ocp.compiled.jit import KERNEL, MATRIX, SCALAR, VECTOR, compiled, float64
from ocp.compiled.parameters import parameters
from ocp.grid import INTERPOLATION, Grid, interpolate
from ocp.grids.hard_obstacles import (
    SEGMENT,
    clear_segment,
    hard_data,
    interpolate_joined,
    interpolate_visible,
)
from ocp.grids.input_samples import sampled_inputs
from ocp.kernels import Kernels, kernels
from ocp.query import Query

# The type of `bellman`
BELLMAN = types.FunctionType(
    float64(
        VECTOR, VECTOR, MATRIX, VECTOR, types.int64,
        ADDRESSES, VECTOR, VECTOR, VECTOR, VECTOR, MATRIX,
    )
)  # fmt: skip
SCRATCH_ROWS = 7
SLACK = 0.3  # share of a step's cost by which the gradient's input may miss the Bellman equation
NEAR = 1.0  # cells from the goal within which the gradient is not used: V is a square root there
OVERSHOOT = 1.2  # a step that speeds up is shortened until it exceeds its cells by no more
MAX_SHORTENINGS = 6
ARRIVAL_DIRECTIONS = 64
SHRINK = 0.4  # of the search interval from one round of refinement to the next

kernel_at = function_at(KERNEL)
scalar_at = function_at(SCALAR)
interpolation_at = function_at(INTERPOLATION)
segment_at = function_at(SEGMENT)
bellman_at = function_at(BELLMAN)

# Two-point Gauss rule on [0, 1]; unlike Simpson's, within 1.2 % for the square-root end of sqrt(W)
# at the goal.
GAUSS = (0.21132486540518713, 0.7886751345948129)


def bellman_addresses(query: Query, for_scheme: bool = False) -> NDArray[np.intp]:
    """The functions that `bellman` calls, itself, and `feedback`, for this query.

    Beside hard obstacles a scheme, whose values feed on each other, mixes values by
    `interpolate_joined`, and a policy by `interpolate_visible`.
    """
    beside = interpolate_joined if for_scheme else interpolate_visible
    return _addresses(kernels(query), beside if query.hard_obstacles else interpolate)


@cache
def _addresses(k: Kernels, mixing: Any) -> NDArray[np.intp]:
    return addresses(
        [k.dynamics, k.state_cost, mixing, clear_segment, bellman, k.optimal_input, feedback]
    )


def bellman_settings(
    query: Query, cells: float = 1.0, longest: float = np.inf
) -> NDArray[np.float64]:
    """Numbers that `bellman` needs beside the query's parameters.

    Args:
        cells: how far a step moves, in cells along the axis on which it moves most.
        longest: the longest duration of a step, in seconds (in arc length for time-free queries).
    """
    # An equilibrium ends no step: the goal is then a point that no step comes near.
    radius = 0.0 if query.is_regulation else query.goal.radius
    center = (
        np.full(len(query.system.position), 1e9) if query.is_regulation else query.goal_position
    )
    return np.array([cells, longest, query.is_time_free, radius, *center], dtype=float)


def bellman_geometry(query: Query, grid: Grid, margin: float = 0.0) -> NDArray[np.float64]:
    """The grid's geometry followed by the hard obstacles."""
    return np.concatenate([grid.geometry, hard_data(query, margin)])


def arrival_costs(
    query: Query, grid: Grid, states: NDArray[np.float64], cells: float
) -> NDArray[np.float64]:
    """Least cost `[k]` to enter the goal ball from `states` `[k, n]` in one step.

    Infinite where no single step of `cells` cells enters it: the value is at most this.
    """
    candidates, spread = sampled_inputs(query, ARRIVAL_DIRECTIONS)
    out = np.empty(len(states))
    nowhere = np.full(grid.size, np.inf)
    _bellman_rows(
        np.ascontiguousarray(states), candidates, spread, 2, bellman_addresses(query),
        parameters(query), bellman_settings(query, cells), nowhere, bellman_geometry(query, grid),
        out,
    )  # fmt: skip
    return out


@compiled(float64(float64, float64, float64, float64))
def _chord(start, middle, end, fraction):
    """The point at `fraction` of the way on the chords from start to middle to end."""
    if fraction <= 0.5:
        return start + 2.0 * fraction * (middle - start)
    return middle + (2.0 * fraction - 1.0) * (end - middle)


@compiled(float64(VECTOR, VECTOR, float64, ADDRESSES, VECTOR, VECTOR, VECTOR, VECTOR, MATRIX))
def step_cost(x, u, w, functions, q, settings, values, geometry, scratch):
    """Cost of a step from `x` `[n]` under the constant input `u` `[m]`, plus the value at its end.

    `w` is W(x). For a time-free query, u must satisfy u' R u = 1; the step is then measured in arc
    length of the R-norm and its cost is the integral of 2 sqrt(W), that of the best speed.
    Otherwise the cost is the integral of W + u' R u over time.

    Infinite if the step crosses a hard obstacle, ends outside the grid, or does not move at all.
    `scratch` `[6, >= n, m]` is overwritten in its rows 0 to 3.
    """
    n, m, d = x.shape[0], u.shape[0], settings.shape[0] - 4
    dynamics = kernel_at(functions[0, 0], functions[0, 1])
    state_cost = scalar_at(functions[1, 0], functions[1, 1])
    mixed_value = interpolation_at(functions[2, 0], functions[2, 1])
    clear = segment_at(functions[3, 0], functions[3, 1])
    rate, middle, end = scratch[0, :n], scratch[1, :n], scratch[2, :n]
    point = scratch[3, :n]
    time_free = settings[2] > 0.0

    dynamics(x, u, rate)
    pace = settings[0] / settings[1]
    for i in range(n):
        pace = max(pace, abs(rate[i]) * geometry[n + i])
    if not pace > 0.0:
        return np.inf
    duration = settings[0] / pace
    for _ in range(MAX_SHORTENINGS):
        for i in range(n):
            middle[i] = x[i] + 0.5 * duration * rate[i]
        dynamics(middle, u, point)
        extent = 0.0
        for i in range(n):
            extent = max(extent, duration * abs(point[i]) * geometry[n + i])
        if extent <= OVERSHOOT * settings[0]:
            break
        duration *= math.sqrt(settings[0] / extent)  # exact where the motion starts from rest
    for i in range(n):
        end[i] = x[i] + duration * point[i]

    effort = 0.0
    if not time_free:
        for i in range(m):
            effort += q[i] * u[i] ** 2

    # First hit of the goal ball, on the chords from x to the middle to the end.
    hit = 2.0
    for half in range(2):
        a, b, c = 0.0, 0.0, -(settings[3] ** 2)
        for i in range(d):
            base = x[i] if half == 0 else middle[i]
            chord = (middle[i] if half == 0 else end[i]) - base
            offset = base - settings[4 + i]
            a += chord * chord
            b += chord * offset
            c += offset * offset
        if c <= 0.0:
            hit = 0.5 * half
            break
        if b < 0.0 and b * b >= a * c:
            fraction = (-b - math.sqrt(b * b - a * c)) / a
            if fraction <= 1.0:
                hit = 0.5 * (half + fraction)
                break

    if geometry[4 * n + 2] > 0.0:
        data = geometry[4 * n :]
        last = min(hit, 1.0)
        for i in range(n):
            point[i] = _chord(x[i], middle[i], end[i], min(last, 0.5))
        if clear(x, point, data) == 0.0:
            return np.inf
        if last > 0.5:
            for i in range(n):
                point[i] = _chord(x[i], middle[i], end[i], last)
            if clear(middle, point, data) == 0.0:
                return np.inf

    if hit <= 1.0:
        total = 0.0
        for node in GAUSS:
            for i in range(n):
                point[i] = _chord(x[i], middle[i], end[i], node * hit)
            w = state_cost(point, q)
            total += 2.0 * math.sqrt(w) if time_free else w + effort
        return 0.5 * hit * duration * total

    onward = mixed_value(values, geometry, end)
    if onward == np.inf:
        return np.inf
    first, second, third = w, state_cost(middle, q), state_cost(end, q)
    if time_free:
        first, second, third = 2 * math.sqrt(first), 2 * math.sqrt(second), 2 * math.sqrt(third)
    return duration * (effort + (first + 4.0 * second + third) / 6.0) + onward


@compiled(types.void(VECTOR, types.int64, float64, VECTOR, VECTOR, VECTOR))
def _moved(u, axis, amount, q, settings, out):
    """Into `out`: `u` moved by `amount` along one input axis, within the bounds.

    Axis `m` is the input's size, changed by the factor 1 + `amount`. For a time-free query `u` is
    turned by the angle `amount` towards the axis, on u' R u = 1.
    """
    m = u.shape[0]
    if settings[2] > 0.0:
        along = u[axis] * math.sqrt(q[axis])
        across = math.sqrt(max(1.0 - along * along, 1e-300))
        # cos(amount) u + sin(amount) (axis - along u) / across
        keep = math.cos(amount) - math.sin(amount) * along / across
        for i in range(m):
            out[i] = keep * u[i]
        out[axis] += math.sin(amount) / (across * math.sqrt(q[axis]))
    else:
        for i in range(m):
            moved = u[i] * (1.0 + amount) if axis == m else u[i]
            if i == axis:
                moved += amount
            out[i] = min(max(moved, q[m + i]), q[2 * m + i])


@compiled(
    float64(
        VECTOR, VECTOR, MATRIX, VECTOR, types.int64,
        ADDRESSES, VECTOR, VECTOR, VECTOR, VECTOR, MATRIX,
    )
)  # fmt: skip
def bellman(x, u, candidates, spread, rounds, functions, q, settings, values, geometry, scratch):
    """min_u of `step_cost` at `x` `[n]`, and its minimiser in `u` `[m]`.

    Tries the given `u` (unless its first entry is NaN) and the `candidates` `[K, m]`, then refines
    the best: in each of `rounds`, along each input axis (and in size), a parabola through the cost
    at the best input and to both sides. The sides are `spread` `[m]` away at first (an angle for a
    time-free query; otherwise at least half the input's size). Never returns more than the best
    candidate.
    """
    m = u.shape[0]
    w = scalar_at(functions[1, 0], functions[1, 1])(x, q)
    best = np.inf
    trial, chosen = scratch[4, :m], scratch[5, :m]
    if not math.isnan(u[0]):
        best = step_cost(x, u, w, functions, q, settings, values, geometry, scratch)
        chosen[:] = u
    for row in range(candidates.shape[0]):
        cost = step_cost(x, candidates[row], w, functions, q, settings, values, geometry, scratch)
        if cost < best:
            best = cost
            chosen[:] = candidates[row]
    if best == np.inf:
        u[:] = 0.0
        return best

    time_free = settings[2] > 0.0
    shrink = 1.0
    for _ in range(rounds):
        skipped = -1
        if time_free:  # the axis along which u points needs no turning
            largest = -1.0
            for i in range(m):
                if abs(chosen[i]) * math.sqrt(q[i]) > largest:
                    largest, skipped = abs(chosen[i]) * math.sqrt(q[i]), i
        for axis in range(m if time_free or m == 1 else m + 1):
            if axis == skipped:
                continue
            if axis == m:
                size = 0.5 * shrink
            elif time_free:
                size = shrink * spread[axis]
            else:
                size = shrink * max(spread[axis], 0.5 * abs(chosen[axis]))
            _moved(chosen, axis, -size, q, settings, trial)
            below = step_cost(x, trial, w, functions, q, settings, values, geometry, scratch)
            _moved(chosen, axis, size, q, settings, trial)
            above = step_cost(x, trial, w, functions, q, settings, values, geometry, scratch)
            bend = below + above - 2.0 * best
            if below < best and below <= above:
                move, cost = -size, below
            elif above < best:
                move, cost = size, above
            elif bend > 0.0 and bend < np.inf:
                move = 0.5 * size * (below - above) / bend
                _moved(chosen, axis, move, q, settings, trial)
                cost = step_cost(x, trial, w, functions, q, settings, values, geometry, scratch)
            else:
                continue
            if cost < best:
                best = cost
                _moved(chosen, axis, move, q, settings, trial)
                chosen[:] = trial
        shrink *= SHRINK
    u[:] = chosen
    return best


@compiled(
    float64(
        VECTOR, VECTOR, MATRIX, VECTOR, types.int64,
        ADDRESSES, VECTOR, VECTOR, VECTOR, VECTOR, MATRIX,
    )
)  # fmt: skip
def feedback(x, u, candidates, spread, rounds, functions, q, settings, values, geometry, scratch):
    """The input of a policy at `x` `[n]`, in `u` `[m]`; returns its `step_cost`.

    The gradient of V by differences over a cell to both sides of `x` (as `GridValue.gradient`) is
    of second order and gives the better input, but not where two motions are equally good (it
    averages theirs), nor next to infinite values or the goal. So its input is taken if a step under
    it keeps the Bellman equation up to `SLACK` of its cost, else that of `bellman`.
    """
    n, m = x.shape[0], u.shape[0]
    mixed_value = interpolation_at(functions[2, 0], functions[2, 1])
    optimal_input = kernel_at(functions[5, 0], functions[5, 1])
    here = mixed_value(values, geometry, x)
    distance, cell = 0.0, 0.0
    for i in range(settings.shape[0] - 4):
        distance += (x[i] - settings[4 + i]) ** 2
        cell = max(cell, settings[0] / geometry[n + i])
    known = here < np.inf and math.sqrt(distance) - settings[3] > NEAR * cell
    z, point = scratch[6], scratch[3, :n]
    for i in range(n):
        z[i] = point[i] = x[i]
    for i in range(n):
        h = 1.0 / geometry[n + i]
        point[i] = x[i] + h
        above = mixed_value(values, geometry, point)
        point[i] = x[i] - h
        below = mixed_value(values, geometry, point)
        point[i] = x[i]
        if above < np.inf and below < np.inf:
            z[n + i] = (above - below) / (2.0 * h)
        elif above < np.inf:
            z[n + i] = (above - here) / h
        elif below < np.inf:
            z[n + i] = (here - below) / h
        else:
            known = False
    if known:
        optimal_input(z[: 2 * n], q, u)
        if settings[2] > 0.0:
            size = 0.0
            for i in range(m):
                size += q[i] * u[i] ** 2
            known = size > 0.0
            for i in range(m):
                u[i] /= math.sqrt(size)
    if known:
        w = scalar_at(functions[1, 0], functions[1, 1])(x, q)
        cost = step_cost(x, u, w, functions, q, settings, values, geometry, scratch)
        if cost < np.inf:
            step = cost - mixed_value(values, geometry, scratch[2, :n])
            if cost - here <= SLACK * step:
                return cost
    u[:] = np.nan
    return bellman(
        x, u, candidates, spread, rounds, functions, q, settings, values, geometry, scratch
    )


@compiled(
    types.void(
        MATRIX, MATRIX, VECTOR, types.int64, ADDRESSES, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR
    )
)
def _bellman_rows(
    states, candidates, spread, rounds, functions, q, settings, values, geometry, out
):
    n, m = states.shape[1], candidates.shape[1]
    scratch = np.empty((SCRATCH_ROWS, max(2 * n, m)))
    u = np.empty(m)
    for row in range(states.shape[0]):
        u[:] = np.nan
        out[row] = bellman(
            states[row], u, candidates, spread, rounds, functions, q, settings, values, geometry,
            scratch,
        )  # fmt: skip
