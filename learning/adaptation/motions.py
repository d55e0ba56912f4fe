"""Motions from the starts: closed loops of the network and of grids, and the exact ones beside."""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learning.conditioned.compiled_network import NetworkValue
from ocp.eikonal import EikonalSolution, solve_eikonal
from ocp.extremals.extremal import Extremal, Precision, find_extremal
from ocp.extremals.warm_start import rollouts, timed
from ocp.grid import Grid
from ocp.grids.lookahead import LookaheadPolicy
from ocp.query import Query
from ocp.threads import warm_workers
from ocp.trajectory import Trajectory

Floats = NDArray[np.float64]

STRIDE = 0.15  # metres or radians: a step of the network's own closed loop
MOST_STEPS = 400
MANY = 4  # starts whose loops are worth another core
MARGIN = 0.5  # metres of the grids beyond the domain
PRECISION = Precision(newton=1e-6, step=1e-6, check=1e-9)
"""Of the exact trajectories: costs to 1e-9, in two thirds of the time."""
SURPRISE = 1.01  # a loop so many times as costly as foreseen; one in twenty is
SUSPICION = 1.003  # a motion so many times as costly as a grid's loop is in the wrong class


@dataclass(frozen=True)
class Loop:
    """A closed loop of the network, as `NetworkValue.drive` left it.

    Attributes:
        path: `[k + 1, 7]`, up to the first state in the goal.
        cost: about its cost.
    """

    path: Floats
    cost: float

    def is_doubted(self, value: float) -> bool:
        """Whether it costs more than its network had said, `value`: it may be in a wrong class."""
        return self.cost > SURPRISE * value

    def motion(self, query: Query) -> Trajectory:
        """The loop as a guess."""
        n, m = query.system.n, query.system.m
        moved = self.path[:-1]
        return timed(query, self.path[:, :n], moved[:, n + m], moved[:, n : n + m])


def network_loops(network: NetworkValue, starts: Floats, cores: int) -> tuple[Loop | None, ...]:
    """The closed loops of a network's policy from `[k, n]`; `None` where one does not arrive.

    Half of many starts are driven on another core. The halves are the same on a single one: in
    single precision a state's V depends, in its last digits, on those evaluated together with it.
    """

    def drive(rows: Floats) -> list[Loop | None]:
        path, steps = network.drive(rows, STRIDE, MOST_STEPS)
        return [
            Loop(path[: count + 1, i].copy(), float(path[count, i, -1])) if count > 0 else None
            for i, count in enumerate(steps)
        ]

    if not len(starts):
        return ()
    if len(starts) < MANY:
        return tuple(drive(starts))
    half = len(starts) // 2
    if cores < 2:
        return (*drive(starts[:half]), *drive(starts[half:]))
    other = warm_workers().submit(drive, starts[half:])
    first = drive(starts[:half])
    return (*first, *(drive(starts[half:]) if other.cancel() else other.result()))


@dataclass(frozen=True)
class GridAnswer:
    """A grid's value, its policy, and that policy's closed loops.

    Attributes:
        solution: the value.
        policy: its policy.
        motions: from each start; `None` where one does not get to the goal.
        seconds: that all this took.
    """

    solution: EikonalSolution
    policy: LookaheadPolicy
    motions: tuple[Trajectory | None, ...]
    seconds: float

    @property
    def costs(self) -> Floats:
        """Of the closed loops, `[k]`; infinite where there is none."""
        return np.array([np.inf if m is None else m.cost_so_far[-1] for m in self.motions])


def solved_grid(query: Query, starts: Floats, nodes: int) -> GridAnswer:
    """A grid of about so many nodes and its closed loops from `[k, n]`."""
    begun = time.perf_counter()
    solution = solve_eikonal(query, Grid.for_query(query, nodes, MARGIN))
    policy = solution.policy()
    motions = tuple(rollouts(query, policy, starts))
    return GridAnswer(solution, policy, motions, time.perf_counter() - begun)


@dataclass(frozen=True)
class Search:
    """What is known where an exact trajectory is to be sought.

    Attributes:
        query: the query.
        start: `[n]`.
        loop: the network's loop from there, if it gets to the goal.
        motion: a grid's loop, if that seems to be in a better class.
        known: an exact trajectory.
    """

    query: Query
    start: Floats
    loop: Loop | None
    motion: Trajectory | None
    known: Extremal | None

    def found(self) -> list[Extremal]:
        """Those beside the grid's loop and beside the network's, solved or not.

        The network's loop is left out once the grid's has led to a motion clearly cheaper.
        """
        found = []
        if self.motion is not None:
            found.append(self._extremal(self.motion))
        if self.loop is not None and self.known is None:
            surpassed = found and found[0].cost * SUSPICION < self.loop.cost
            if not surpassed:
                found.append(self._extremal(self.loop.motion(self.query)))
        return found

    def _extremal(self, guess: Trajectory) -> Extremal:
        return find_extremal(self.query, self.start, guess, precision=PRECISION)
