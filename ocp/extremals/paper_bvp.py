"""The fixed-time problem of Xu and Zhu (section III-C) and its two-point boundary value problem.

Paper -> here, at a time t_f fixed beforehand:
    (17)  minimise S(x(t_f)) + integral of L          S(x) = exp(2 (|p - x_g|^2 - r_g^2))
    (18)  x' = f + G u, lambda' = -dH/dx, v' = -L;    lambda(t_f) = dS/dx, v(t_f) = S
    (19)  V(t, x(t)) = v(t), u(t, x(t)) = u(t)
The robot goes on inside the goal, where S falls from 1 to exp(-2 r_g^2): V is biased.

`solve_paper_bvp` solves it as the paper does, by a collocation scheme of three stages (its [17];
here SciPy's `solve_bvp`, of order 4). Two repairs make it computable. S overflows beyond 18.8 m:
the conditions at t_f are divided by 1 + S, which leaves their solutions as they are. And Q has a
kink at the goal's boundary, at which the scheme does not converge: Q is replaced by
Q^3 / (Q^2 + delta^2), delta = `smoothing`, which is twice differentiable at the boundary and falls
short of Q by delta^2 / Q far from it. Where a motion crosses a kink of a polygon's penalty, the
scheme still fails. `shoot_paper_bvp` solves the same problem, as it stands, by multiple shooting,
which knows the kinks.
"""

import math
import time
from dataclasses import dataclass, replace

import numpy as np
from numba import types
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.batch import optimal_inputs, running_costs
from ocp.compiled.jit import KERNEL, KERNEL_WITH_JACOBIAN, MATRIX, SCALAR, VECTOR, compiled, float64
from ocp.extremals.extremal import SEGMENTS, Extremal, find_extremal
from ocp.extremals.first_iterate import with_costates
from ocp.extremals.hamiltonian_flow import flow_addresses, flow_layout, propagate
from ocp.extremals.transversality import exponential_condition
from ocp.kernels import kernels, parameters
from ocp.pontryagin import exact_trajectory
from ocp.query import Query
from ocp.trajectory import SolveError, Status, Trajectory

Array = NDArray[np.float64]

STEEPNESS = 2.0  # of S
SMOOTHING = 0.05
LONGER = 1.5  # the paper leaves t_f open; by default so many times the guess's duration
FINE = 4000  # intervals for the cost of the answer


@dataclass(frozen=True)
class PaperSolution:
    """What the boundary value solver says of (18).

    Attributes:
        status: SOLVED, NOT_CONVERGED, or DID_NOT_REACH if the motion stays outside the goal.
        detail: the solver's own words.
        value: v(0), the value of (17) at the start; NaN unless converged.
        trajectory: states, inputs and costates to t_f, with the cost of the unsmoothed L; `None`
            unless converged.
        cost_to_goal: cost of the unsmoothed L up to the first hit of the goal ball; NaN if none.
        nodes: of the solver's last mesh, or points of the trajectory.
        seconds: spent by the solver.
    """

    status: Status
    detail: str
    value: float
    trajectory: Trajectory | None
    cost_to_goal: float
    nodes: int
    seconds: float


@dataclass(frozen=True)
class Bias:
    """By how much (17) is off the free-time optimum.

    Attributes:
        value: v(0) - V.
        cost: cost of its motion up to the goal - V.
    """

    value: float
    cost: float


def solve_paper_bvp(
    query: Query,
    start: ArrayLike,
    guess: Trajectory,
    *,
    horizon: float | None = None,
    smoothing: float = SMOOTHING,
    tolerance: float = 1e-3,
    max_nodes: int = 4000,
) -> PaperSolution:
    """Solve (18) from `start` `[n]`; the answer's status says how it ended.

    Args:
        query: the query.
        start: a state in the domain.
        guess: a motion to the goal, such as a rollout; at the goal it is prolonged by standing.
        horizon: t_f in seconds; by default 1.5 times the guess's duration.
        smoothing: delta of Q; 0 keeps the kink.
        tolerance: of `solve_bvp`, relative residual.
        max_nodes: of its mesh, at which it gives up.

    Raises:
        ValueError: if an argument does not fit.
    """
    from scipy.integrate import solve_bvp

    start, horizon = _checked(query, start, guess, horizon)
    if not (np.isfinite(smoothing) and smoothing >= 0):
        raise ValueError(f"smoothing: must be a finite number >= 0, got {smoothing}")
    n = query.system.n
    flow = _Flow(query, smoothing)
    mesh, rough = _prolonged(query, guess, horizon)
    rough[:n, 0] = start

    def ends(first: Array, last: Array) -> Array:
        return np.concatenate([first[:n] - start, _terminal_residual(query, last)])

    begun = time.perf_counter()
    # Wild iterates overflow; solve_bvp then halves its step.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        answer = solve_bvp(
            lambda _, y: flow(y), ends, mesh, rough, tol=tolerance, max_nodes=max_nodes
        )
    seconds = time.perf_counter() - begun
    nodes = len(answer.x)
    if not answer.success:
        return PaperSolution(
            Status.NOT_CONVERGED, answer.message, np.nan, None, np.nan, nodes, seconds
        )
    trajectory = _fine(query, answer.sol, horizon)
    cost = _cost_to_goal(query, trajectory)
    status = Status.SOLVED if np.isfinite(cost) else Status.DID_NOT_REACH
    value = float(answer.sol(0.0)[2 * n])
    return PaperSolution(status, answer.message, value, trajectory, cost, nodes, seconds)


def shoot_paper_bvp(
    query: Query, start: ArrayLike, guess: Trajectory, *, horizon: float | None = None
) -> PaperSolution:
    """Solve (18) from `start` `[n]` by multiple shooting; arguments as for `solve_paper_bvp`.

    Raises:
        ValueError: if an argument does not fit.
    """
    start, horizon = _checked(query, start, guess, horizon)
    condition = exponential_condition(query, STEEPNESS)
    usual = LONGER * guess.duration
    extremal = Extremal(Status.NOT_CONVERGED)
    # At once, or else by way of the horizon that is solved most easily.
    for way in ([horizon], [usual, math.sqrt(usual * horizon), horizon]):
        rough = guess
        for seconds in way:
            rough = _standing(query, rough, seconds)
            extremal = find_extremal(query, start, rough, condition, segments=2 * SEGMENTS)
            rough = extremal.trajectory or rough
        if extremal.trajectory is not None:
            break
    trajectory = extremal.trajectory
    if trajectory is None:
        return PaperSolution(
            extremal.status, extremal.detail, np.nan, None, np.nan, 0, extremal.seconds
        )
    value = trajectory.cost + float(terminal_cost(query, trajectory.states[-1]))
    cost = _cost_to_goal(query, trajectory)
    status = Status.SOLVED if np.isfinite(cost) else Status.DID_NOT_REACH
    nodes = len(trajectory.times)
    return PaperSolution(status, "", value, trajectory, cost, nodes, extremal.seconds)


def paper_bias(query: Query, start: ArrayLike, horizon: float | None = None) -> Bias:
    """The bias of (17) at `start` `[n]`, by multiple shooting on both problems.

    Raises:
        SolveError: if either problem could not be solved.
    """
    exact = exact_trajectory(query, start)
    solution = shoot_paper_bvp(query, start, exact, horizon=horizon)
    if solution.status is not Status.SOLVED:
        raise SolveError(solution.status, solution.detail)
    return Bias(solution.value - exact.cost, solution.cost_to_goal - exact.cost)


def _checked(
    query: Query, start: ArrayLike, guess: Trajectory, horizon: float | None
) -> tuple[Array, float]:
    checked = query.check_start(start)
    if not guess.duration > 0:
        raise ValueError(f"guess: must last longer than 0 s, got {guess.duration}")
    horizon = LONGER * guess.duration if horizon is None else horizon
    if not (np.isfinite(horizon) and horizon > 0):
        raise ValueError(f"horizon: must be a positive finite number of seconds, got {horizon}")
    return checked, horizon


def _cost_to_goal(query: Query, trajectory: Trajectory) -> float:
    """Cost up to the first hit of the goal; NaN if there is none.

    The time of the hit is bisected along the Hamiltonian flow from the last point outside.
    """
    inside = np.flatnonzero(query.goal_distance(trajectory.states) <= 0)
    if len(inside) == 0:
        return np.nan
    k = int(inside[0])
    if k == 0:
        return 0.0
    assert trajectory.costates is not None
    n = query.system.n
    z = np.concatenate([trajectory.states[k - 1], trajectory.costates[k - 1]])
    arguments = flow_addresses(kernels(query)), parameters(query), flow_layout(query)
    low, high = 0.0, float(trajectory.times[k] - trajectory.times[k - 1])
    none = np.empty((2 * n, 0))
    y = np.append(z, 0.0)
    for _ in range(60):
        middle = (low + high) / 2
        y = np.append(z, 0.0)
        propagate(*arguments, y, none, middle, 1e-12, np.zeros(1), np.empty(0), np.empty((0, 0)))
        low, high = (middle, high) if query.goal_distance(y[:n]) > 0 else (low, middle)
    return float(trajectory.cost_so_far[k - 1] + y[2 * n])


def _standing(query: Query, guess: Trajectory, horizon: float) -> Trajectory:
    """`guess` for so many seconds: cut, or prolonged by standing still."""
    times, columns = _prolonged(query, guess, horizon)
    n = query.system.n
    inputs = np.zeros((len(times), query.system.m))
    states, costates = columns[:n].T.copy(), columns[n : 2 * n].T.copy()
    return Trajectory(times, states, inputs, costates, columns[2 * n, 0] - columns[2 * n])


def terminal_cost(query: Query, states: ArrayLike) -> Array:
    """S `[...]` at states `[..., n]`; infinite where it overflows."""
    with np.errstate(over="ignore"):
        return np.exp(_exponent(query, np.asarray(states, dtype=float)))


def _exponent(query: Query, states: Array) -> Array:
    offset = query.position(states) - query.goal_position
    return STEEPNESS * ((offset**2).sum(axis=-1) - query.goal.radius**2)


def _terminal_residual(query: Query, last: Array) -> Array:
    """(lambda - dS/dx, v - S) over 1 + S, at `last` = [x, lambda, v], without overflow."""
    n = query.system.n
    exponent = float(_exponent(query, last[:n]))
    ours, theirs = 1.0 / (1.0 + np.exp(min(exponent, 700.0))), 1.0 / (1.0 + np.exp(-exponent))
    slope = np.zeros(n)
    place = list(query.system.position)
    slope[place] = 2.0 * STEEPNESS * (last[place] - query.goal_position)
    return np.append(last[n : 2 * n] * ours - slope * theirs, last[2 * n] * ours - theirs)


class _Flow:
    """The right side of (18), Q smoothed, for `[2n + 1, k]` columns [x, lambda, v]."""

    def __init__(self, query: Query, smoothing: float) -> None:
        # The same kernels evaluate Q alone when all other weights of W are 0.
        M = query.cost.state
        zero = None if M is None else tuple(tuple(0.0 for _ in row) for row in M)
        alone = replace(query, obstacles=(), cost=replace(query.cost, state=zero))
        k = kernels(query)
        self._functions = k.flow, k.minimised_hamiltonian, k.state_cost, k.state_cost_derivatives
        self._arguments = parameters(query), parameters(alone), float(smoothing)

    def __call__(self, columns: Array) -> Array:
        rows = np.ascontiguousarray(columns.T)
        out = np.empty_like(rows)
        _smoothed_flow(*self._functions, *self._arguments, rows, out)
        return out.T


@compiled(
    types.void(
        *(KERNEL, SCALAR, SCALAR, KERNEL_WITH_JACOBIAN),
        *(VECTOR, VECTOR, float64, MATRIX, MATRIX),
    )
)
def _smoothed_flow(flow, hamiltonian, state_cost, derivatives, q, alone, delta, rows, out):
    n = (rows.shape[1] - 1) // 2
    z, rate = np.empty(2 * n), np.empty(2 * n)
    slope, unused = np.empty(n), np.empty((n, n))
    for row in range(rows.shape[0]):
        z[:] = rows[row, : 2 * n]
        flow(z, q, rate)
        cost = hamiltonian(z, q)
        for i in range(n):
            cost -= z[n + i] * rate[i]
        if delta > 0.0:
            Q = state_cost(z, alone)
            derivatives(z, alone, slope, unused)
            share = Q * Q / (Q * Q + delta * delta)
            cost += Q * (share - 1.0)
            for i in range(n):  # d(Q share)/dQ = share (3 - 2 share)
                rate[n + i] -= slope[i] * (share * (3.0 - 2.0 * share) - 1.0)
        out[row, : 2 * n] = rate
        out[row, 2 * n] = -cost


def _prolonged(query: Query, guess: Trajectory, horizon: float) -> tuple[Array, Array]:
    """A mesh `[k]` and [x, lambda, v] `[2n + 1, k]` there: the guess, then standing still."""
    guess = with_costates(query, guess)
    assert guess.costates is not None
    S = min(float(terminal_cost(query, guess.states[-1])), 1e6)
    times = np.unique(np.concatenate([np.linspace(0, horizon, 60), guess.times]))
    times = times[(times <= horizon) & np.append(True, np.diff(times) > 1e-9 * horizon)]
    times[-1] = horizon
    columns = np.column_stack([guess.states, guess.costates, guess.cost_to_go + S])
    return times, np.array([np.interp(times, guess.times, c) for c in columns.T])


def _fine(query: Query, solution, horizon: float) -> Trajectory:
    """The answer on a fine grid of times, with the cost of the unsmoothed running cost."""
    n = query.system.n
    times = np.linspace(0, horizon, FINE + 1)
    y = solution(times).T
    states, costates = np.ascontiguousarray(y[:, :n]), np.ascontiguousarray(y[:, n : 2 * n])
    inputs = optimal_inputs(query, states, costates)
    rate = running_costs(query, states, inputs)
    so_far = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(times))])
    return Trajectory(times, states, inputs, costates, so_far)
