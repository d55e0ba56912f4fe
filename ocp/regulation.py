"""Exact motions to an equilibrium.

V(x) is the least cost of regulation for ever. Near the equilibrium x_g it is x'P x + O(|x|^3), P
the solution of the algebraic Riccati equation. So a motion is solved over a horizon T with the
terminal cost x'P x (direct collocation), T is raised until that term hardly counts, and from T on
the linear regulator takes over. The motion's cost is what the robot really pays, tail included:
never below V, and above it by the small error of the tail alone.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from itertools import product

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.collocation import solve_collocation
from ocp.compiled.batch import optimal_inputs, rates, running_costs
from ocp.equilibrium import linearise
from ocp.extremals.fixed_time import solve_fixed_time
from ocp.query import Query
from ocp.riccati import AlgebraicRiccati, LinearQuadratic, algebraic_riccati
from ocp.trajectory import SolveError, Status, Trajectory

Array = NDArray[np.float64]

TERMINAL_SHARE = 1e-3  # of the cost, that the regulator's tail may be
TAIL_SHARE = 1e-10  # of the cost, that is left where a motion ends
FIRST_HORIZONS = (1.5, 4.0)  # in units of `_time_scale`
LONGEST = 60.0  # seconds
STEP = 0.01  # seconds, of the tail and the second derivatives
WANDERING = 1.5  # a guess that costs so many times the cheapest is not refined


@lru_cache(maxsize=256)
def regulator(query: Query) -> AlgebraicRiccati:
    """The linear regulator at the goal's equilibrium, for the running cost there.

    Raises:
        ValueError: if the goal is no equilibrium, or it cannot be stabilised; the mode is named.
        SolveError: if the Riccati equation was not solved.
    """
    if not query.is_regulation:
        raise ValueError("goal: must be an equilibrium (goal.state) for a regulator")
    x_g = query.reference
    A, B = linearise(query.system, x_g, query.reference_input)
    hessian = state_cost_hessian(query)(x_g)
    M = np.array(hessian) / 2
    return algebraic_riccati(
        LinearQuadratic(A, B, (M + M.T) / 2, np.diag(query.input_weights), x_g)
    )


def solve_regulation(
    query: Query,
    start: ArrayLike,
    guess: Trajectory | None = None,
    *,
    intervals: int = 30,
    time_limit: float = 120.0,
) -> Trajectory:
    """The cheapest motion found from `start` `[n]` to rest in the goal's equilibrium.

    Without a guess straight ones are tried: each way round in the coordinates that turn, slowly and
    fast. The motion goes on under the linear regulator until next to nothing of its cost is left.

    Args:
        query: with an `Equilibrium` as its goal.
        start: a state in the domain, outside hard obstacles.
        guess: a motion to start from.
        intervals: of the first mesh.
        time_limit: seconds for each solve.

    Raises:
        ValueError: if an argument does not fit, or the equilibrium cannot be stabilised.
        SolveError: if no guess led to an answer.
    """
    start = query.check_start(start)
    P = regulator(query).matrix
    failures: list[SolveError] = []
    found: list[Trajectory] = []
    guesses = _guesses(query, start) if guess is None else iter([guess])
    for rough in guesses:
        try:
            motion = solve_collocation(
                query,
                start,
                rough,
                horizon=rough.duration,
                terminal_cost=P,
                intervals=intervals,
                tolerance=1e-3,
                max_intervals=8 * intervals,
                time_limit=time_limit,
                state_tolerance=1e-3,
            )
            found.append(motion)
        except SolveError as failure:
            failures.append(failure)
    answers: list[Trajectory] = []
    for motion in sorted(found, key=lambda m: _total(query, m)):
        if answers and _total(query, motion) > WANDERING * min(a.cost for a in answers):
            break
        if any(abs(_total(query, motion) / a.cost - 1) < 1e-4 for a in answers):
            continue
        try:
            answers.append(_settled(query, start, motion, intervals, time_limit))
        except SolveError as failure:
            failures.append(failure)
    if not answers:
        raise failures[0]
    return min(answers, key=lambda m: m.cost)


def _total(query: Query, motion: Trajectory) -> float:
    end = query.terminal_cost(motion.states[-1], regulator(query).matrix)
    return motion.cost + end


def _settled(
    query: Query, start: Array, motion: Trajectory, intervals: int, time_limit: float
) -> Trajectory:
    """Raise the horizon until the terminal cost hardly counts; the tail is appended."""
    P = regulator(query).matrix
    slowest = 1.0 / regulator(query).decay_rate
    while True:
        left = query.terminal_cost(motion.states[-1], P)
        close = query.goal_distance(motion.states[-1]) <= 0
        if close and left <= TERMINAL_SHARE * (motion.cost + left):
            return with_tail(query, motion)
        longer = 1.3 * motion.duration + 0.5 * slowest
        if longer > LONGEST:
            raise SolveError(
                Status.NOT_CONVERGED, f"after {motion.duration:.3g} s the robot is not at rest yet"
            )
        extended = with_tail(query, motion, longer)
        motion = solve_collocation(
            query,
            start,
            replace(extended, costates=None),
            horizon=longer,
            terminal_cost=P,
            intervals=intervals,
            tolerance=1e-5,
            max_intervals=8 * intervals,
            time_limit=time_limit,
            state_tolerance=1e-4,
        )


def pmp_regulation(query: Query, guess: Trajectory) -> Trajectory:
    """The extremal near a motion of `solve_regulation`, by multiple shooting; tail included.

    Raises:
        SolveError: if there is none, see `solve_fixed_time`.
    """
    remaining = guess.cost_to_go / guess.cost
    last = int(np.argmax(remaining <= TERMINAL_SHARE))
    head = replace(
        guess,
        times=guess.times[: last + 1],
        states=guess.states[: last + 1],
        inputs=guess.inputs[: last + 1],
        costates=None if guess.costates is None else guess.costates[: last + 1],
        cost_so_far=guess.cost_so_far[: last + 1],
    )
    P = regulator(query).matrix
    motion = solve_fixed_time(query, guess.start, head.duration, P, head)
    return with_tail(query, motion.trajectory)


def with_tail(query: Query, motion: Trajectory, until: float | None = None) -> Trajectory:
    """`motion` carried on by the linear regulator, its input within the bounds.

    Args:
        query: with an `Equilibrium` as its goal.
        motion: ends near the equilibrium.
        until: the time to end at; by default when next to nothing of the cost is left.

    Raises:
        SolveError: DID_NOT_REACH if the regulator does not bring the robot to rest.
    """
    value = RegulatorValue(query)
    state, time = motion.states[-1].copy(), motion.duration
    cost = motion.cost
    most = until if until is not None else time + 40.0 / regulator(query).decay_rate
    step = step_of(query)
    times, states, costs = [], [], []
    while time < most - 1e-12 and (
        until is not None or value.value(state) > TAIL_SHARE * (cost + value.value(state))
    ):
        h = min(step, most - time)
        state, spent = _advanced(query, value, state, h)
        time, cost = time + h, cost + spent
        if not np.isfinite(state).all():
            raise SolveError(Status.DID_NOT_REACH, "the linear regulator diverges")
        times.append(time)
        states.append(state)
        costs.append(cost)
    if until is None and value.value(state) > TAIL_SHARE * (cost + value.value(state)):
        raise SolveError(Status.DID_NOT_REACH, "the linear regulator does not come to rest")
    if not times:
        return motion
    tail = np.array(states)
    costates = value.gradient(tail)
    return Trajectory(
        np.concatenate([motion.times, times]),
        np.concatenate([motion.states, tail]),
        np.concatenate([motion.inputs, optimal_inputs(query, tail, costates)]),
        None if motion.costates is None else np.concatenate([motion.costates, costates]),
        np.concatenate([motion.cost_so_far, costs]),
    )


def step_of(query: Query) -> float:
    """Seconds; so few that the fastest mode of the regulator's closed loop is resolved."""
    lq = regulator(query).problem
    fastest = np.abs(np.linalg.eigvals(lq.A - lq.B @ regulator(query).gain())).max()
    return min(STEP, float(0.2 / fastest))


def _advanced(query: Query, value: "RegulatorValue", x: Array, h: float) -> tuple[Array, float]:
    """A Runge-Kutta step under the regulator: the state after it, and its cost."""

    def slope(y: Array) -> tuple[Array, float]:
        u = optimal_inputs(query, y, value.gradient(y))
        return rates(query, y, u), float(running_costs(query, y, u))

    k1, c1 = slope(x)
    k2, c2 = slope(x + h / 2 * k1)
    k3, c3 = slope(x + h / 2 * k2)
    k4, c4 = slope(x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), h / 6 * (c1 + 2 * c2 + 2 * c3 + c4)


def _guesses(query: Query, start: Array) -> Iterator[Trajectory]:
    """Straight motions to the equilibrium, each way round, of several durations."""
    system = query.system
    offset = system.difference(query.reference, start)
    turns = [
        (0.0, -np.sign(d) * p) if p and abs(d) > 0.25 * p else (0.0,)
        for d, p in zip(offset, system.period, strict=True)
    ]
    scale = _time_scale(query, start)
    for horizon, way in product(FIRST_HORIZONS, list(product(*turns))[:4]):
        seconds = min(horizon * scale, LONGEST / 4)
        fractions = np.linspace(0.0, 1.0, 64)
        states = start + fractions[:, None] * (offset + np.array(way))
        inputs = np.tile(query.reference_input, (64, 1))
        spent = running_costs(query, states, inputs)
        costs = np.concatenate([[0.0], np.cumsum((spent[1:] + spent[:-1]) / 2)]) * seconds / 63
        yield Trajectory(seconds * fractions, states, inputs, None, costs, Status.NOT_CONVERGED)


def _time_scale(query: Query, start: Array) -> float:
    """Seconds: of the regulator's slowest decay, or half a swing of the robot where it starts."""
    A, _ = linearise(query.system, start, query.reference_input)
    turning = np.abs(np.linalg.eigvals(A).imag)
    swings = np.pi / turning[turning > 0.1]
    return float(max(1.0 / regulator(query).decay_rate, swings.max(initial=0.5)))


class RegulatorValue:
    """x'P x, the cost of the linear regulator; exact to second order at the equilibrium."""

    def __init__(self, query: Query) -> None:
        self.query = query
        self.P = regulator(query).matrix

    def value(self, states: ArrayLike) -> Array:
        """`[...]` at states `[..., n]`."""
        e = self.query.system.difference(states, self.query.reference)
        return np.einsum("...i,ij,...j->...", e, self.P, e)

    def gradient(self, states: ArrayLike) -> Array:
        """2 P x, `[..., n]`, at states `[..., n]`."""
        e = self.query.system.difference(states, self.query.reference)
        return 2.0 * e @ self.P


@lru_cache(maxsize=64)
def state_cost_hessian(query: Query) -> ca.Function:
    """x -> the second derivatives `[n, n]` of the state's share of the running cost."""
    x = query.system.state
    return ca.Function(
        "hessian", [x], [ca.densify(ca.hessian(query.state_cost_expression(x), x)[0])]
    )
