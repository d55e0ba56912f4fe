"""First guesses for extremals: motions completed with costates, rollouts of policies, continuation.

A guess is a `Trajectory` that need satisfy nothing exactly. One without costates gets them from the
adjoint equation p' = -dH/dx along it, backward from p = 0.
"""

from dataclasses import replace
from functools import cache

import numpy as np
from numba import types
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.batch import running_costs, state_costs
from ocp.compiled.function_address import ADDRESSES, addresses, function_at
from ocp.compiled.jit import KERNEL, KERNEL_WITH_JACOBIAN, MATRIX, VECTOR, compiled
from ocp.kernels import Kernels, kernels
from ocp.query import Query
from ocp.trajectory import Status, Trajectory
from ocp.value import GreedyPolicy, Policy, Value

Array = NDArray[np.float64]

STRIDE = 0.015  # of the domain's extent: length of a rollout's step where time is free
PERIOD = 0.05  # seconds: a rollout's step otherwise
MAX_STEPS = 800

kernel_at = function_at(KERNEL)
derivatives_at = function_at(KERNEL_WITH_JACOBIAN)


def until_goal(query: Query, guess: Trajectory) -> Trajectory:
    """`guess` up to its first hit of the goal ball; all of it if there is none."""
    distance = query.goal_distance(guess.states)
    inside = np.flatnonzero(distance <= 0)
    if len(inside) == 0 or inside[0] == 0:
        return guess
    k = int(inside[0])
    part = distance[k - 1] / (distance[k - 1] - distance[k])

    def cut(columns: Array) -> Array:
        return np.concatenate(
            [columns[:k], [columns[k - 1] + part * (columns[k] - columns[k - 1])]]
        )

    return replace(
        guess,
        times=cut(guess.times),
        states=cut(guess.states),
        inputs=cut(guess.inputs),
        costates=None if guess.costates is None else cut(guess.costates),
        cost_so_far=cut(guess.cost_so_far),
    )


def onward(guess: Trajectory, time: float) -> Trajectory:
    """The rest of a motion from `time` on: the guess for a start further along it."""
    times = np.concatenate([[time], guess.times[guess.times > time]])
    rest = resampled(guess, times)
    return replace(
        rest, times=rest.times - time, cost_so_far=rest.cost_so_far - rest.cost_so_far[0]
    )


def resampled(guess: Trajectory, times: Array) -> Trajectory:
    """A motion at other times, linear in between."""

    def at(columns: Array) -> Array:
        return np.column_stack([np.interp(times, guess.times, c) for c in columns.T])

    costates = None if guess.costates is None else at(guess.costates)
    cost = np.interp(times, guess.times, guess.cost_so_far)
    return Trajectory(times, at(guess.states), at(guess.inputs), costates, cost, guess.status)


def policy_of(query: Query, source: Value | Policy) -> Policy:
    """A policy as it is; a value's lookahead policy on a grid, else its greedy one."""
    from ocp.grid import GridValue
    from ocp.grids.lookahead import LookaheadPolicy

    if callable(source):
        return source  # pyright: ignore[reportReturnType]
    if isinstance(source, GridValue):
        return LookaheadPolicy(query, source)
    return GreedyPolicy(query, source)


def rollouts(query: Query, policy: Policy, starts: ArrayLike) -> list[Trajectory | None]:
    """Rough closed-loop motions from states `[k, n]`; `None` where one does not get to the goal.

    Where time is free they are steps of constant length, at the best speed; else of constant time.
    """
    from ocp.grids.lookahead import LookaheadPolicy

    system = query.system
    states = np.array(np.atleast_2d(np.asarray(starts, dtype=float)))
    stride = STRIDE * (system.upper - system.lower)[list(system.position)].max()
    if isinstance(policy, LookaheadPolicy) and policy.query == query and not query.is_regulation:
        goal = np.append(query.goal_position, query.goal.radius)
        step = stride if query.is_time_free else PERIOD
        path, inputs, durations, lengths = policy.motions(goal, states, step, MAX_STEPS)
    else:
        path, inputs, durations, lengths = _stepped(query, policy, states, stride)
    found: list[Trajectory | None] = []
    for row, count in enumerate(lengths):
        if count < 1:
            found.append(None)
            continue
        motion, seconds = path[row, : count + 1].copy(), durations[row, :count].copy()
        outside, inside = query.goal_distance(motion[-2:])
        part = outside / (outside - inside)
        motion[-1] = motion[-2] + part * (motion[-1] - motion[-2])
        seconds[-1] *= part
        found.append(timed(query, motion, seconds, inputs[row, :count].copy()))
    return found


def _stepped(
    query: Query, policy: Policy, states: Array, stride: float
) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """As `LookaheadPolicy.motions`, for any policy."""
    path, moves, times = [states], [], []
    lengths = np.where(query.goal_distance(states) <= 0, 0, -1)
    for k in range(1, MAX_STEPS + 1):
        inputs = policy(states)
        if query.is_time_free:
            effort = np.sqrt((query.input_weights * inputs**2).sum(axis=-1))
            durations = stride / np.maximum(effort, 1e-12)
        else:
            durations = np.full(len(states), PERIOD)
        states = advanced(query, states, inputs, durations)
        path.append(states)
        moves.append(inputs)
        times.append(durations)
        lengths[(lengths < 0) & (query.goal_distance(states) <= 0)] = k
        if (lengths >= 0).all():
            break
    return np.stack(path, axis=1), np.stack(moves, axis=1), np.stack(times, axis=1), lengths


def timed(query: Query, states: Array, durations: Array, inputs: Array) -> Trajectory:
    """A guess from states `[k + 1, n]` and the durations `[k]` and inputs `[k, m]` between them.

    Without drift, durations and inputs are rescaled to the best speed (the mean of both ends'), or
    what the bounds allow.
    """
    middles = (states[1:] + states[:-1]) / 2
    if not query.system.has_drift:
        effort = (query.input_weights * inputs**2).sum(axis=-1)
        best = np.sqrt(state_costs(query, states))
        best = np.maximum((best[1:] + best[:-1]) / 2, 1e-9)
        faster = best / np.sqrt(np.maximum(effort, 1e-300))
        lower, upper = query.input_bounds
        room = np.where(inputs > 0, upper, lower)
        allowed = np.abs(room) / np.maximum(np.abs(inputs), 1e-300)
        faster = np.maximum(np.minimum(faster, allowed.min(axis=-1)), 1e-6)
        inputs, durations = inputs * faster[:, None], durations / faster
    costs = np.cumsum(durations * running_costs(query, middles, inputs))
    return Trajectory(
        np.concatenate([[0.0], np.cumsum(durations)]),
        states,
        np.concatenate([inputs[:1], inputs]),
        None,
        np.concatenate([[0.0], costs]),
        Status.NOT_CONVERGED,
    )


def advanced(query: Query, states: Array, inputs: Array, durations: Array) -> Array:
    """States `[k, n]` after one midpoint step under inputs `[k, m]` held for durations `[k]`."""
    out = np.empty_like(states)
    _midpoint(_dynamics_address(kernels(query)), states, inputs, durations, out)
    return out


@cache
def _dynamics_address(compiled_query: Kernels) -> NDArray[np.intp]:
    return addresses([compiled_query.dynamics])


@compiled(types.void(ADDRESSES, MATRIX, MATRIX, VECTOR, MATRIX))
def _midpoint(functions, states, inputs, durations, out):
    dynamics = kernel_at(functions[0, 0], functions[0, 1])
    n = states.shape[1]
    rate, half = np.empty(n), np.empty(n)
    for row in range(states.shape[0]):
        x, u, h = states[row], inputs[row], durations[row]
        dynamics(x, u, rate)
        for i in range(n):
            half[i] = x[i] + h / 2 * rate[i]
        dynamics(half, u, rate)
        for i in range(n):
            out[row, i] = x[i] + h * rate[i]
