"""First guesses for trajectory optimisation: turn, drive, turn, past either side of what blocks.

Guesses know no robot: directions in which the robot can move come from its input matrix.
"""

import math
from itertools import pairwise

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ocp.compiled.batch import running_costs, state_costs
from ocp.query import Query
from ocp.trajectory import Status, Trajectory

Array = NDArray[np.float64]

PIECES = 64  # linear pieces of a guess
ORIENTATIONS = 72  # sampled values of a periodic coordinate
MAX_ROUTES = 16
DETOUR = 1.2  # a detour passes an obstacle at this multiple of its radius


def default_guesses(
    query: Query, start: Array, horizon: float | None = None, limit: int = 5
) -> list[Trajectory]:
    """Up to `limit` rough motions from `start` `[n]` to the goal, the most promising first.

    One for each side of the obstacles in the way and each way of driving (forward, backward), and
    one that slips straight to the goal without turning, which alone leads to the optimum from some
    states beside the goal. They respect neither dynamics nor hard obstacles exactly. With a
    `horizon` they are stretched to take that many seconds.
    """
    routes = _routes(query, start)
    guesses = [
        _timed(query, _resampled(states), horizon)
        for route in routes
        for states in _oriented(query, start, route)
    ]
    slip = np.repeat(start[None], 2, axis=0)
    slip[1, list(query.system.position)] = routes[0][-1]
    slipping = _timed(query, _resampled(slip), horizon)

    def rank(guess: Trajectory) -> tuple[float, float]:
        depth = max(0.0, -float(query.clearance(guess.states, hard_only=True).min()))
        return depth, guess.cost

    guesses = sorted(guesses, key=rank)
    if _turning_axis(query) is not None:
        guesses.insert(1, slipping)
    return guesses[:limit]


def _routes(query: Query, start: Array) -> list[Array]:
    """Polylines `[k, d]` from the start to the goal's boundary, round what blocks or through it."""
    center = query.goal_position
    first = query.position(start)
    offset = first - center
    distance = float(np.linalg.norm(offset))
    last = center + offset * min(1.0, query.goal.radius / distance) if distance > 0 else center
    pending: list[tuple[list[Array], frozenset[int]]] = [([first, last], frozenset())]
    routes = []
    while pending and len(routes) < MAX_ROUTES:
        points, passed = pending.pop(0)
        blocked = _first_blocked(query, points, passed)
        if blocked is None:
            routes.append(np.array(points))
            continue
        leg, which = blocked
        o = query.obstacles[which]
        if not o.hard:
            pending.append((points, passed | {which}))
        reach = DETOUR * o.radius + 1.5 * query.robot_radius
        for side in _sideways(points[leg + 1] - points[leg]):
            way = [*points[: leg + 1], np.array(o.center) + reach * side, *points[leg + 1 :]]
            pending.append((way, passed | {which}))
    return routes


def _first_blocked(
    query: Query, points: list[Array], passed: frozenset[int]
) -> tuple[int, int] | None:
    """(leg, obstacle) where the polyline first meets an obstacle not yet dealt with."""
    for leg, (a, b) in enumerate(pairwise(points)):
        samples = a + np.linspace(0, 1, 50)[:, None] * (b - a)
        met = []
        for k, o in enumerate(query.obstacles):
            inside = o.signed_distance(samples) < query.robot_radius
            if k not in passed and inside.any():
                met.append((int(inside.argmax()), k))
        if met:
            return leg, min(met)[1]
    return None


def _sideways(direction: Array) -> list[Array]:
    """Unit vectors across `direction` `[d]`: none on a line, two in the plane, four in space."""
    d, length = len(direction), np.linalg.norm(direction)
    if d == 1 or length == 0:
        return []
    _, _, basis = np.linalg.svd(direction[None] / length)
    return [sign * row for row in basis[1:] for sign in (1.0, -1.0)]


def _oriented(query: Query, start: Array, route: Array) -> list[Array]:
    """State polylines `[k, n]` along a route, one for each way of pointing the robot."""
    system = query.system
    place = list(system.position)
    axis = _turning_axis(query)
    if axis is None:
        states = np.repeat(start[None], len(route), axis=0)
        states[:, place] = route
        return [states]
    ways = []
    for way in range(2):
        states = [start.copy()]
        for a, b in pairwise(route):
            options = _orientations(query, states[-1], axis, b - a)
            turned = states[-1].copy()
            turned[axis] = options[way % len(options)]
            # Unwrapped, the short way round.
            turned[axis] -= system.period[axis] * round(
                (turned[axis] - states[-1][axis]) / system.period[axis]
            )
            moved = turned.copy()
            moved[place] = b
            states += [turned, moved]
        ways.append(np.array(states))
    return ways if not np.array_equal(*ways) else ways[:1]


def _turning_axis(query: Query) -> int | None:
    """The first periodic coordinate that is no position."""
    system = query.system
    for i, c in enumerate(system.coordinates):
        if c.periodic and i not in system.position:
            return i
    return None


def _orientations(query: Query, state: Array, axis: int, direction: Array) -> list[float]:
    """Values of coordinate `axis` at which the inputs best move the robot along `direction`."""
    system, coordinate = query.system, query.system.coordinates[axis]
    length = np.linalg.norm(direction)
    if length == 0:
        return [float(state[axis])]
    step = coordinate.extent / ORIENTATIONS
    towards = direction / length

    def misfits(angles: Array) -> Array:
        states = np.repeat(state[None], len(angles), axis=0)
        states[:, axis] = angles
        matrices = _input_matrices(query, states)[:, list(system.position)]
        reached = (matrices @ np.linalg.pinv(matrices) @ towards[:, None])[..., 0]
        return np.linalg.norm(reached - towards, axis=-1)

    angles = coordinate.lower + step * np.arange(ORIENTATIONS, dtype=float)
    misfit = misfits(angles)
    least = np.flatnonzero((misfit <= np.roll(misfit, 1)) & (misfit < np.roll(misfit, -1)))
    if len(least) == 0:  # all orientations do equally well
        return [float(state[axis])]
    best = []
    for angle in angles[least]:
        nearby = step * np.linspace(-1.0, 1.0, 41) + float(angle)
        best.append(float(nearby[misfits(nearby).argmin()]))
    values = misfits(np.array(best))
    return [b for b, value in zip(best, values, strict=True) if value <= values.min() + 0.05]


def _input_matrices(query: Query, states: Array) -> Array:
    """G `[k, n, m]` at states `[k, n]`."""
    system = query.system
    function = ca.Function("G", [system.state], [ca.densify(system.input_matrix)])
    stacked = np.array(function.map(len(states))(states.T))
    return stacked.reshape(system.n, len(states), system.m).transpose(1, 0, 2)


def _resampled(corners: Array) -> Array:
    """A state polyline `[k, n]` cut into about `PIECES` pieces, the corners kept."""
    lengths = np.abs(np.diff(corners, axis=0)).sum(axis=1)
    total = lengths.sum()
    if total == 0:
        return np.repeat(corners[:1], 2, axis=0)
    parts = [corners[:1]]
    for a, b, length in zip(corners[:-1], corners[1:], lengths, strict=True):
        if length > 0:
            count = max(2, math.ceil(PIECES * length / total))
            parts.append(a + np.linspace(0, 1, count + 1)[1:, None] * (b - a))
    return np.concatenate(parts)


def _timed(query: Query, states: Array, horizon: float | None) -> Trajectory:
    """Times and inputs for a state polyline `[k, n]`.

    Without drift the speed is the optimal one, u' R u = W (or what the bounds allow); with drift,
    one metre a second.
    """
    system = query.system
    middles, moves = (states[1:] + states[:-1]) / 2, np.diff(states, axis=0)
    push = np.linalg.pinv(_input_matrices(query, middles))
    if system.has_drift:
        durations = np.linalg.norm(query.position(moves), axis=-1)
    else:
        W = state_costs(query, middles)
        effort = (push @ moves[..., None])[..., 0]
        floor = 1e-3 * W.max() if W.max() > 0 else 1.0
        durations = np.sqrt((query.input_weights * effort**2).sum(-1) / np.maximum(W, floor))
        lower, upper = query.input_bounds
        room = np.where(effort > 0, upper, -lower)
        durations = np.maximum(durations, (np.abs(effort) / np.maximum(room, 1e-3)).max(-1))
    if durations.sum() <= 0:
        durations = np.full(len(moves), 1.0 / len(moves))
    durations = np.maximum(durations, 1e-9 * durations.sum())
    if horizon is not None:
        durations *= horizon / durations.sum()
    drift = np.array(
        system.dynamics.map(len(middles))(middles.T, np.zeros((system.m, len(middles))))
    ).T
    inputs = (push @ (moves / durations[:, None] - drift)[..., None])[..., 0]
    inputs = np.clip(inputs, *query.input_bounds)
    costs = np.concatenate([[0.0], np.cumsum(durations * running_costs(query, middles, inputs))])
    times = np.concatenate([[0.0], np.cumsum(durations)])
    at_nodes = np.concatenate([inputs[:1], inputs])
    return Trajectory(times, states, at_nodes, None, costs, Status.NOT_CONVERGED)
