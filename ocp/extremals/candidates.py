"""Guesses for every class of motions: either side of obstacles, driving forward and backward.

Near a state where two classes cost the same, no local method finds the cheaper one for sure, and a
coarse value may point the wrong way. So many guesses are made: the closed loop of a coarse value,
from the start and after each of several first moves that it would not make; and rough routes round
the obstacles in the way.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ocp.compiled.batch import optimal_inputs, state_costs
from ocp.extremals.characteristics import backward_characteristics
from ocp.extremals.extremal import find_extremal
from ocp.extremals.guess import default_guesses
from ocp.extremals.transversality import quadratic_condition
from ocp.extremals.warm_start import advanced, policy_of, rollouts, timed, until_goal
from ocp.grid import Grid, GridValue
from ocp.grids.input_samples import unit_directions
from ocp.grids.semi_lagrangian import sweep_time_free
from ocp.query import Query
from ocp.trajectory import SolveError, Status, Trajectory
from ocp.value import Policy, Value

Array = NDArray[np.float64]

NODES = 12_000  # of the coarse value: some 3 % off, for 20 ms
MAX_DIMENSION = 3
MARGIN = 0.5  # metres beyond the domain: optimal motions may leave it
FIRST_MOVES = 8
FIRST_LENGTH = 1.2  # of a first move, in the R-norm of the input
FIRST_STEPS = 12
ALIKE = 0.02  # of the domain: guesses that stay as close together are one
FAN = np.linspace(-2.0, 2.0, 13)  # see `_grown`
FAN_KEPT = 3
CLOSE = 0.5  # in units of that scale
HORIZONS = np.array([0.5, 1.0, 2.0, 4.0])  # seconds a metre to the goal; see `_fixed_time`
PULL = 50.0  # weight of the squared distance to the goal's centre at the end
FINE_SEGMENTS = 48
NEAR = 0.05  # metres to the goal: nearer, a coarse value is no guide
GROWN = 0.5  # metres to the goal: nearer, extremals grown from the goal pass by the start
MAX_GUESSES = 10
FEWEST_STEPS = 10  # a rough motion of fewer steps has too rough a cost to bound the optimum
WORSE = 1.4  # a guess that costs so many times the best rough motion's is not worth a solve


@lru_cache(maxsize=16)
def coarse_value(query: Query) -> GridValue | None:
    """A quick value to roll out; `None` where there is no quick one (drift, bounds, dimension)."""
    if not query.is_time_free or query.system.n > MAX_DIMENSION:
        return None
    grid = Grid.for_query(query, NODES, margin=MARGIN)
    try:
        return GridValue(grid, sweep_time_free(query, grid).checked().values)
    except (SolveError, ValueError):  # too coarse for a small goal: routes must do
        return None


@dataclass(frozen=True)
class Candidates:
    """Guesses, no two alike, the most promising first.

    Attributes:
        guesses: rough motions, some with costates.
        bound: about the cost of the best closed loop among them, which the optimum should not
            exceed; infinite if there is none (routes are no motions of the robot).
    """

    guesses: list[Trajectory]
    bound: float


def candidate_guesses(
    query: Query, start: Array, source: Value | Policy | None = None
) -> Candidates:
    """Guesses from `start` `[n]`.

    Args:
        query: the query.
        start: outside the goal.
        source: a value or policy to roll out; by default a coarse value, if there is one.
    """
    # Bounds change the speed more than the path: without drift, the paths come from the unbounded
    # query.
    free = query if query.system.has_drift else unbounded(query)
    source = source if source is not None else coarse_value(free)
    distance = float(query.goal_distance(start))
    motions = []
    if source is not None and distance > NEAR:
        motions = _closed_loops(free, policy_of(free, source), start)
        motions = [_retimed(query, g) for g in motions] if query.is_bounded else motions
    elif query.system.has_drift:
        motions = _fixed_time(query, start)
    bound = min((g.cost for g in motions if len(g.times) >= FEWEST_STEPS), default=np.inf)
    if distance < GROWN and query.system.n <= MAX_DIMENSION:
        motions = _grown(query, start) + motions
    motions += default_guesses(query, start, limit=6)
    least, alike = motions[0].cost, ALIKE * min(1.0, distance)
    chosen: list[Trajectory] = []
    outlines: list[Array] = []
    for guess in motions:
        outline = _outline(query, guess)
        new = all(np.abs(outline - other).max() > alike for other in outlines)
        if (
            new
            and guess.cost <= WORSE * least + 0.5 * min(1.0, distance)
            and len(chosen) < MAX_GUESSES
        ):
            chosen.append(guess)
            outlines.append(outline)
    return Candidates(chosen, bound)


def _grown(query: Query, start: Array) -> list[Trajectory]:
    """The extremals, of a fan grown from the goal's boundary, that pass nearest to `start`.

    Near the goal, at the distance d, motions change coordinates other than distance by about the
    root of d: at a graze that takes the longest, cost is saved by sliding along the boundary.
    """
    system = query.system
    place = list(system.position)
    d, size = float(query.goal_distance(start)), len(system.position)
    outward = query.position(start) - query.goal_position
    _, _, basis = np.linalg.svd(outward[None])
    across = np.zeros((system.n - 1, system.n))  # all directions but the goal's
    across[: size - 1, place] = basis[1:]
    across[size - 1 :, [i for i in range(system.n) if i not in place]] = np.eye(system.n - size)
    steps = np.array(list(product(*([FAN * np.sqrt(d)] * (system.n - 1)))))
    reach = np.sqrt(float(state_costs(query, start)) + 1e-12) * (d + np.sqrt(d))
    fan = backward_characteristics(query, start + steps @ across, 6 * reach, tolerance=1e-7)
    scale = np.full(system.n, np.sqrt(d))
    scale[place] = d
    gaps = np.abs((fan.states - start) / scale).max(axis=-1)
    nearest, point = np.nanmin(gaps, axis=1), np.nanargmin(gaps, axis=1)
    cost = np.where(nearest < CLOSE, fan.costs[np.arange(len(point)), point], np.inf)
    motions = []
    # The nearest of all, and the cheapest of those that are close.
    for row in dict.fromkeys([*np.argsort(nearest)[:FAN_KEPT], *np.argsort(cost)[:FAN_KEPT]]):
        k = point[row]
        if k < 1:
            continue
        back = slice(k, None, -1)
        states, costates = fan.states[row, back], fan.costates[row, back]
        costs = fan.costs[row, k] - fan.costs[row, back]
        inputs = optimal_inputs(query, states, costates)
        times = fan.times[row, k] - fan.times[row, back]
        motions.append(Trajectory(times, states, inputs, costates, costs, Status.NOT_CONVERGED))
    return motions


def unbounded(query: Query) -> Query:
    """The query without input bounds."""
    return replace(query, input_lower=None, input_upper=None)


def _retimed(query: Query, guess: Trajectory) -> Trajectory:
    """The same path, as fast as is good within the bounds."""
    return timed(query, guess.states, np.diff(guess.times), guess.inputs[1:])


def _fixed_time(query: Query, start: Array) -> list[Trajectory]:
    """Motions of fixed durations whose end is pulled to the goal's centre, up to the goal.

    First with neither obstacles nor goal cost (for linear robots one Newton step), then with all.
    """
    place = list(query.system.position)
    pull = np.zeros((query.system.n, query.system.n))
    pull[place, place] = PULL
    condition = quadratic_condition(query.reference, pull)
    bare = replace(unbounded(query), obstacles=(), cost=replace(query.cost, goal=0.0))
    motions = []
    for horizon in HORIZONS * max(1.0, float(query.goal_distance(start))):
        rough = default_guesses(query, start, float(horizon), limit=1)[0]
        first = find_extremal(bare, start, rough, condition, segments=FINE_SEGMENTS).trajectory
        if first is None:
            continue
        full = find_extremal(query, start, first, condition, segments=FINE_SEGMENTS).trajectory
        ends = [until_goal(query, m) for m in (full, replace(first, costates=None)) if m]
        slack = 1e-2 * query.goal.radius
        motions += [m for m in ends if query.goal_distance(m.states[-1]) < slack][:1]
    return sorted(motions, key=lambda g: g.cost)


def _closed_loops(query: Query, policy: Policy, start: Array) -> list[Trajectory]:
    """Closed loops from `start`, at once and after each of several first moves; cheapest first."""
    system = query.system
    directions = np.zeros((1, system.m))  # the first row stays at the start
    if query.is_time_free:
        moves = unit_directions(system.m, FIRST_MOVES) / np.sqrt(query.input_weights)
        directions = np.concatenate([directions, moves])
    durations = np.full(len(directions), FIRST_LENGTH / FIRST_STEPS)
    states = np.repeat(start[None], len(directions), axis=0)
    heads = [states]
    for _ in range(FIRST_STEPS):
        states = advanced(query, states, directions, durations)
        states[0] = start
        heads.append(states)
    path = np.array(heads)
    outside = (query.goal_distance(path) > 0).all(axis=0)
    clear = (query.clearance(path, hard_only=True) >= 0).all(axis=0)
    rows = np.flatnonzero(outside & clear)
    found = []
    for row, tail in zip(rows, rollouts(query, policy, states[rows]), strict=True):
        if tail is None:
            continue
        if row > 0:
            inputs = np.repeat(directions[row][None], FIRST_STEPS, axis=0)
            steps = durations[:1].repeat(FIRST_STEPS)
            tail = _joined(timed(query, path[:, row], steps, inputs), tail)
        found.append(tail)
    return sorted(found, key=lambda g: g.cost)


def _joined(head: Trajectory, tail: Trajectory) -> Trajectory:
    return replace(
        head,
        times=np.concatenate([head.times, head.duration + tail.times[1:]]),
        states=np.concatenate([head.states, tail.states[1:]]),
        inputs=np.concatenate([head.inputs, tail.inputs[1:]]),
        cost_so_far=np.concatenate([head.cost_so_far, head.cost + tail.cost_so_far[1:]]),
    )


def _outline(query: Query, guess: Trajectory) -> Array:
    """A motion's states at equal shares of its cost, over the domain's extent."""
    shares = np.linspace(0, guess.cost, 12)
    system = query.system
    columns = [np.interp(shares, guess.cost_so_far, c) for c in guess.states.T]
    return np.column_stack(columns) / (system.upper - system.lower)
