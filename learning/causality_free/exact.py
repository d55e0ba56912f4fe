"""Exact trajectories to an equilibrium, from the closed loop of a value that is only roughly right.

The closed loop of the network (or of the linear regulator) is the guess; multiple shooting on
Pontryagin's conditions makes it exact. The motion ends on the linear regulator's ellipsoid
e' P e = small, with the costate 2 P e of the stable manifold there: no grid, and no order in which
states have to be treated. (The continuation in Nakamura-Zimmerer, Gong and Kang, "Adaptive deep
learning for high-dimensional Hamilton-Jacobi-Bellman equations", SIAM J. Sci. Comput. 2021, whose
guesses come from the network too.)
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from learning.causality_free.sidestep import Sidesteps, nearness
from ocp.compiled.batch import optimal_inputs, running_costs
from ocp.extremals.extremal import SEGMENTS, Precision, find_extremal
from ocp.extremals.transversality import quadratic_condition
from ocp.extremals.warm_start import advanced
from ocp.query import Query
from ocp.regulation import RegulatorValue, regulator
from ocp.trajectory import Status, Trajectory
from ocp.value import Value

Array = NDArray[np.float64]

TAIL = 3e-4  # of the cost, that may be left where the linear regulator takes over
LONGEST = 20.0  # seconds of a guess
DETOUR = 1.7  # times the longest motion known, that one past another side may last
STEP = 0.02  # seconds of a guess's step, at most
PRECISION = Precision(step=1e-11)
GROWTH, MAX_SEGMENTS = 1.5, 200  # exponent by which errors may grow in a segment; how many
FIRST_SHARE = 0.4  # of the way (to the start, to the obstacles' weight) where continuation begins
MOST_CONTINUATIONS = 16  # motions tried
FELT = 0.02  # penalty of an obstacle along a motion that is worth passing it on another side
FAR = 1e3  # a loop that gets so far has diverged


@dataclass(frozen=True)
class Optimum:
    """An exact motion.

    Attributes:
        motion: with costates, up to the ellipsoid.
        values: `[k]`, V at its points, the tail's cost included.
    """

    motion: Trajectory
    values: Array

    @property
    def cost(self) -> float:
        """V at the start."""
        return float(self.values[0])


def closed_loops(
    query: Query, value: Value, starts: ArrayLike, longest: float = LONGEST
) -> list[Trajectory | None]:
    """Rough closed loops of a value's greedy policy from states `[k, n]`, all advanced together.

    They end on the linear regulator's ellipsoid; `None` where one is not there after `longest`
    seconds.
    """
    states = np.array(np.atleast_2d(np.asarray(starts, dtype=float)))
    count, ends = len(states), RegulatorValue(query)
    step = min(STEP, 0.2 / _fastest_rate(query))
    path, costates, inputs, costs = [states], [], [], [np.zeros(count)]
    last = np.full(count, -1)
    lost = np.zeros(count, dtype=bool)
    for k in range(int(longest / step)):
        costates.append(value.gradient(states))
        u = optimal_inputs(query, states, costates[-1])
        inputs.append(u)
        now = costs[-1] + step * running_costs(query, states, u)
        going = ~lost & (last < 0)
        moved = states.copy()
        moved[going] = advanced(query, states[going], u[going], np.full(going.sum(), step))
        lost |= ~(np.abs(moved).max(axis=1) < FAR)
        moved[lost] = states[lost]
        states = moved
        path.append(states)
        costs.append(now)
        left = ends.value(states)
        arrived = going & ~lost & (left <= TAIL * (now + left))
        last[arrived] = k + 1
        if (lost | (last >= 0)).all():
            break
    costates.append(value.gradient(states))
    found: list[Trajectory | None] = []
    for i, end in enumerate(last):
        if end < 0:
            found.append(None)
            continue
        xs = np.array([p[i] for p in path[: end + 1]])
        us = np.array([u[i] for u in [*inputs, inputs[-1]][: end + 1]])
        cost = np.array([c[i] for c in costs[: end + 1]])
        ps = np.array([p[i] for p in costates[: end + 1]])
        times = step * np.arange(end + 1)
        found.append(Trajectory(times, xs, us, ps, cost, Status.NOT_CONVERGED))
    return found


def exact_from(query: Query, guess: Trajectory) -> Optimum | None:
    """The extremal near a closed loop; `None` if there is none, or it does not come to rest."""
    P = regulator(query).matrix
    end = guess.states[-1]
    center = end - query.system.difference(end, query.reference)  # it may be whole turns away
    found = find_extremal(
        query,
        guess.states[0],
        guess,
        quadratic_condition(center, P),
        segments=_segments(query, guess.duration),
        precision=PRECISION,
    )
    motion = found.trajectory
    if motion is None or motion.costates is None:
        return None
    tail = float(RegulatorValue(query).value(motion.states[-1]))
    if not tail <= 5 * TAIL * (motion.cost + tail):
        return None
    return Optimum(motion, motion.cost_to_go + tail)


def continued(query: Query, start: ArrayLike) -> Optimum | None:
    """The exact motion from `start` `[n]`, grown from the equilibrium; `None` if that gets stuck.

    On the straight line from the equilibrium to the start, each motion found, stretched about the
    equilibrium, is the guess for the next start; steps that fail are halved.
    """
    start = np.asarray(start, dtype=float)
    offset = query.system.difference(start, query.reference)
    share, step = 0.0, FIRST_SHARE
    found: Optimum | None = None
    for _ in range(MOST_CONTINUATIONS):
        reached = min(1.0, share + step)
        here = start if reached == 1.0 else query.reference + reached * offset
        if found is None:
            guess = closed_loops(query, RegulatorValue(query), here)[0]
        else:
            guess = _stretched(query, found.motion, here, reached / share)
        trial = None if guess is None else exact_from(query, guess)
        if trial is None:
            step /= 2
            continue
        found, share, step = trial, reached, 1.5 * step
        if share == 1.0:
            return found
    return None


def _stretched(query: Query, motion: Trajectory, start: Array, ratio: float) -> Trajectory:
    """`motion` enlarged about the equilibrium: exact for a linear robot with quadratic cost."""
    assert motion.costates is not None
    states = query.reference + ratio * (motion.states - query.reference)
    states[0] = start
    return Trajectory(
        motion.times,
        states,
        query.reference_input + ratio * (motion.inputs - query.reference_input),
        ratio * motion.costates,
        ratio**2 * motion.cost_so_far,
        Status.NOT_CONVERGED,
    )


def exact_trajectories(
    query: Query,
    values: Sequence[Value],
    starts: ArrayLike,
    continuation: bool = True,
    ways: bool = True,
) -> list[Optimum | None]:
    """Exact motions from states `[k, n]`, by the first of `values` whose closed loop leads to one.

    Where none does, by continuation from the equilibrium, unless that is not wanted; `None` where
    that fails too. Among obstacles the cheapest of that motion and of those that pass the obstacles
    it feels on either side, if such `ways` are wanted.
    """
    rows = np.atleast_2d(np.asarray(starts, dtype=float))
    found: list[Optimum | None] = [None] * len(rows)
    for value in values:
        missing = [i for i, optimum in enumerate(found) if optimum is None]
        if not missing:
            break
        for i, guess in zip(missing, closed_loops(query, value, rows[missing]), strict=True):
            if guess is not None:
                found[i] = exact_from(query, guess)
    for i, optimum in enumerate(found):
        if optimum is None and query.obstacles:
            found[i] = among_growing_obstacles(query, values[-1], rows[i])
        if found[i] is None and continuation:
            found[i] = continued(query, rows[i])
    return _cheapest_way(query, found, rows) if ways else found


def among_growing_obstacles(query: Query, value: Value, start: Array) -> Optimum | None:
    """The exact motion from `start` `[n]`, continued from the one without obstacles, or `None`."""
    cost = query.cost
    guess = closed_loops(replace(query, obstacles=()), value, start)[0]
    share, step = 0.0, FIRST_SHARE
    for _ in range(MOST_CONTINUATIONS):
        if guess is None:
            return None
        reached = min(1.0, share + step)
        weaker = replace(query, cost=replace(cost, obstacle=reached * cost.obstacle))
        found = exact_from(query if reached == 1.0 else weaker, guess)
        if found is None:
            step /= 2
            continue
        guess, share, step = found.motion, reached, 1.5 * step
        if share == 1.0:
            return found
    return None


def _cheapest_way(query: Query, found: list[Optimum | None], starts: Array) -> list[Optimum | None]:
    """Each motion held against those that pass the obstacles it feels on either side."""
    ways = [
        (i, k, side)
        for i, optimum in enumerate(found)
        for k, obstacle in enumerate(query.obstacles)
        if optimum is None or nearness(query, obstacle, optimum.motion.states) > FELT
        for side in (1, -1)
    ]
    best = list(found)
    if not ways:
        return best
    rows, passed, sides = (np.array(column) for column in zip(*ways, strict=True))
    known = [LONGEST if o is None else DETOUR * o.motion.duration for o in found]
    longest = min(LONGEST, max(known[i] for i in rows))
    guesses = closed_loops(query, Sidesteps(query, passed, sides), starts[rows], longest)
    for i, guess in zip(rows, guesses, strict=True):
        rival = None if guess is None else exact_from(query, guess)
        mine = best[i]
        if rival is not None and (mine is None or rival.cost < mine.cost):
            best[i] = rival
    return best


def _segments(query: Query, duration: float) -> int:
    """So many segments that errors grow little in one; the flow's fastest rates are the loop's."""
    return int(np.clip(np.ceil(duration * _fastest_rate(query) / GROWTH), SEGMENTS, MAX_SEGMENTS))


def _fastest_rate(query: Query) -> float:
    lq = regulator(query).problem
    return float(np.abs(np.linalg.eigvals(lq.A - lq.B @ regulator(query).gain())).max())
