"""Fast marching against a deadline: a ladder of grids, each begun only if it will end in time.

The smallest grid is solved first. Its time, held against the ladder's usual one, is this machine's
rate now; the next grid is the largest whose predicted time still fits. Without a deadline there is
nothing to weigh, and one grid of the default size is solved.
"""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ocp.eikonal import NODES, EikonalSolution, solve_eikonal
from ocp.grids.lookahead import LookaheadPolicy
from ocp.query import Query
from ocp.value import Value

log = logging.getLogger(__name__)

LADDER = {
    4_500: 3.7e-3,
    9_000: 5.5e-3,
    18_000: 9.2e-3,
    36_000: 16e-3,
    60_000: 30e-3,
    120_000: 65e-3,
    240_000: 190e-3,
}
"""Nodes, and the time one solve usually takes, seconds of a 2020s core: only ratios matter."""
CAUTION = 1.25  # a solve may take so many times its predicted time
CHECKED_FROM = 0.05  # seconds of deadline: from here on the first, smallest grid is checked too

Starts = Sequence[NDArray[np.float64]]
Solve = Callable[[Query, int], EikonalSolution]
Check = Callable[[Query, LookaheadPolicy, Starts], bool]


@dataclass(frozen=True)
class LadderState:
    """The best answer so far.

    Attributes:
        query, starts: what was asked.
        begun: when, on the planner's clock.
        solution: the finest value whose policy passed its check, or the first one.
        policy: its policy.
        checked: whether rollouts from every start reached the goal.
        nodes: asked of the last grid solved, whether or not its policy passed.
        pace: its time over the ladder's usual one.
        check_seconds: what the last check took.
        following: nodes of the next grid; `None` if no larger one ends in time.
        next_seconds: predicted for that, its check included.
    """

    query: Query
    starts: tuple[NDArray[np.float64], ...]
    begun: float
    solution: EikonalSolution
    policy: LookaheadPolicy
    checked: bool
    nodes: int
    pace: float
    check_seconds: float
    following: int | None = None
    next_seconds: float = 0.0
    trajectories: int = 0

    @property
    def finished(self) -> bool:
        return self.following is None


@dataclass(frozen=True)
class EikonalPlanner:
    """Grids as fine as the time allows.

    Attributes:
        seconds: until the deadline; `None` solves one grid of the default size.
        clock: seconds that pass; a test's own may be put here.
        solve: (query, nodes) -> solution.
        check: (query, policy, starts) -> whether its rollouts reach the goal.
    """

    seconds: float | None = None
    clock: Callable[[], float] = time.perf_counter
    solve: Solve = lambda query, nodes: solve_eikonal(query, nodes=nodes)
    check: Check = lambda query, policy, starts: reaches(query, policy, starts)

    def __post_init__(self) -> None:
        if self.seconds is not None and not self.seconds > 0:
            raise ValueError(f"seconds: must be positive, got {self.seconds}")

    def start(self, query: Query, starts: Starts) -> LadderState:
        """One grid: the smallest, or without a deadline the default one.

        Raises:
            SolveError: if no grid value can be found.
        """
        begun = self.clock()
        nodes = NODES if self.seconds is None else min(LADDER)
        solution = self.solve(query, nodes)
        policy = solution.policy()
        solved = self.clock()
        checked, took = False, 0.0
        if starts and self.seconds is not None and self.seconds >= CHECKED_FROM:
            checked, took = self._checked(query, policy, starts)
        pace = (solved - begun) / LADDER[nodes]
        state = LadderState(
            query, tuple(starts), begun, solution, policy, checked, nodes, pace, took
        )
        return state if self.seconds is None else self._foresee(state)

    def refine(self, state: LadderState) -> LadderState:
        """The next grid. Its policy counts only if its rollouts reach the goal from every start."""
        if state.following is None:
            return state
        began = self.clock()
        solution = self.solve(state.query, state.following)
        policy = solution.policy()
        pace = (self.clock() - began) / LADDER[state.following]
        checked, took = True, state.check_seconds
        if state.starts:
            checked, took = self._checked(state.query, policy, state.starts)
        new = replace(state, nodes=state.following, pace=pace, check_seconds=took)
        if checked or not state.checked:
            new = replace(new, solution=solution, policy=policy, checked=checked)
        else:
            log.info("the policy on %d nodes misses the goal; the coarser one is kept", new.nodes)
        return self._foresee(new)

    def policy(self, state: LadderState) -> LookaheadPolicy:
        return state.policy

    def value(self, state: LadderState) -> Value:
        return state.solution.value

    def _checked(self, query: Query, policy: LookaheadPolicy, starts: Starts) -> tuple[bool, float]:
        began = self.clock()
        return self.check(query, policy, starts), self.clock() - began

    def _foresee(self, state: LadderState) -> LadderState:
        """Choose the largest grid that ends in time, at the pace of the last one."""
        assert self.seconds is not None
        left = state.begun + self.seconds - self.clock()
        check = state.check_seconds if state.check_seconds else 2 * LADDER[min(LADDER)] * state.pace
        check *= bool(state.starts)
        following, needed = None, 0.0
        for nodes, usual in LADDER.items():
            seconds = CAUTION * (usual * state.pace + check)
            if nodes > state.nodes and seconds < left:
                following, needed = nodes, seconds
        return replace(state, following=following, next_seconds=needed)


def reaches(query: Query, policy: LookaheadPolicy, starts: Starts) -> bool:
    """Whether rough rollouts of `policy` from all `starts` reach the goal, clear of hard obstacles.

    A start in the goal is there already.
    """
    from ocp.extremals.warm_start import rollouts

    outside = [start for start in starts if query.goal_distance(start) > 0]
    if not outside:
        return True
    motions = rollouts(query, policy, np.array(outside))
    return all(
        m is not None and bool((query.clearance(m.states, hard_only=True) >= 0).all())
        for m in motions
    )
