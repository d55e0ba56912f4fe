"""The main method: the policy of a network that knows the query, then better ones while time lasts.

A conditioned network answers in a millisecond. Its own closed loops are the guesses from which
exact trajectories are found; around each a tube of neighbouring extremals steers. Grids replace the
network as the policy off the tubes where their closed loops are better, and tell where the network
chose the wrong class of motions. While one step is taken, those to come are computed on the
machine's other cores.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from learning.adaptation.ahead import Ahead
from learning.adaptation.motions import SUSPICION, network_loops, solved_grid
from learning.adaptation.schedule import (
    COARSE,
    FEW,
    FIRST,
    LAST,
    READY,
    Clock,
    Step,
    machine_clock,
    steps,
)
from learning.adaptation.state import Base, MetaState, unknown
from learning.conditioned.compiled_network import NetworkPolicy, NetworkValue
from learning.conditioned.pretrained_weights import Pretrained, load_pretrained
from learning.conditioned.query_encoder import QueryEncoder
from learning.conditioned.tube import TubePolicy, TubeValue
from ocp.planning import Plan, Until, plan
from ocp.query import Query
from ocp.query_family import sample_start
from ocp.threads import usable_cores
from ocp.trajectory import SolveError, Status
from ocp.value import Policy, Value

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class MetaPlanner:
    """A `Planner` on a trained network.

    Attributes:
        networks: the first that knows a query is used for it.
        grids: whether to use grids at all; without, only network and exact trajectories.
        seconds: the deadline that plans will be given, if one. Then grids follow the exact
            trajectories, ever finer as long as they end in time, and whatever is ready first is
            used first. Only where a loop costs more than the network foresaw a grid is begun first.
        suspicion: a motion so many times as costly as a grid's loop from the same start is held
            to be in the wrong class, and one beside the grid's is sought; infinite for never.
        cores: that it may occupy. Without a deadline the answer does not depend on how many.
        clock: the times that steps take.

    Example:
        >>> from ocp.planning import trajectories
        >>> from ocp.query_family import PAPER_START, paper_query
        >>> planner = MetaPlanner.pretrained("paper")
        >>> plan = planner.plan(paper_query((4.0, 4.0)), [PAPER_START], trajectories(1))
        >>> plan.trajectories, bool(abs(plan.value.value(PAPER_START) / 23.2998 - 1) < 1e-4)
        (1, True)
    """

    networks: tuple[Pretrained, ...]
    grids: bool = True
    seconds: float | None = None
    suspicion: float = SUSPICION
    cores: int = field(default_factory=usable_cores)
    clock: Clock = field(default_factory=machine_clock)

    @classmethod
    def pretrained(
        cls,
        name: str,
        grids: bool = True,
        seconds: float | None = None,
        suspicion: float = SUSPICION,
    ) -> "MetaPlanner":
        """The planner on shipped weights, `paper` or `general`.

        Raises:
            ValueError: if there are no such weights, or they are damaged.
        """
        return cls((load_pretrained(name),), grids, seconds, suspicion)

    @classmethod
    def shipped(cls, grids: bool = True, seconds: float | None = None) -> "MetaPlanner":
        """The planner on all shipped weights, each used for the queries that it knows best."""
        return cls((load_pretrained("paper"), load_pretrained("general")), grids, seconds)

    def plan(
        self, query: Query, starts: Sequence[ArrayLike] = (), until: Until | None = None
    ) -> Plan:
        """`ocp.plan` with this planner, for the `starts` `[n]` that matter most.

        Raises:
            ValueError: if a start does not fit.
            SolveError: NOT_APPLICABLE if the network cannot know such a query.
        """
        return plan(self, query, starts, until)

    def start(self, query: Query, starts: Sequence[NDArray[np.float64]]) -> MetaState:
        """The network's policy, checked from the starts `[n]`; a coarse grid's if it fails.

        Raises:
            SolveError: NOT_APPLICABLE if the network cannot know such a query.
        """
        begun = time.perf_counter()
        self.clock.forget()
        encoder = QueryEncoder.of(query)
        chosen = next((p for p in self.networks if p.knows(query)), None)
        if chosen is None:
            raise SolveError(Status.NOT_APPLICABLE, "the network was trained on other queries")
        network = NetworkValue(encoder, chosen.weights)
        rows = np.array(starts, dtype=float).reshape(-1, query.system.n)
        first, doubted = FIRST if self.grids else 0, True
        grids = Ahead(partial(solved_grid, query, rows))
        if first and self.cores > 1 and self.seconds is None:
            grids = grids.begun([first], 1)
        loops = network_loops(network, rows, self.cores)
        if self.grids and self.seconds is not None:
            foreseen = zip(loops, network.value(rows), strict=True)
            doubted = any(loop is None or loop.is_doubted(V) for loop, V in foreseen)
            first = self._timely_grid(begun, len(rows), doubted)
            if first and self.cores > 1 and doubted:
                grids = grids.begun([first], 1)
        costs = np.array([np.inf if loop is None else loop.cost for loop in loops])
        costs = np.where(query.goal_distance(rows) > 0, costs, 0.0)
        state = MetaState(
            query,
            network,
            rows,
            len(rows),
            begun,
            loops,
            (Base(NetworkPolicy(network), network, costs, chosen.worth_nodes),),
            steps(len(rows), first, self.seconds is not None, doubted),
            Ahead(unknown),
            grids,
            (None,) * len(rows),
        )
        state = state.with_searches()
        if self.grids and np.isinf(costs).any():
            state = state.with_grid(solved_grid(query, rows, COARSE), COARSE, self.suspicion)
        return self._ordered(state)

    def refine(self, state: MetaState) -> MetaState:
        """One exact trajectory or one grid more."""
        if state.finished:
            return state
        state = self._look_ahead(state)
        return self._ordered(self._taken(state, state.pending[0]))

    def settled(self, state: MetaState) -> MetaState:
        """With the grids and exact trajectories that other cores have finished; see `Settles`."""
        while ready := [s for s in state.pending if self._is_ready(state, s)]:
            state = self._taken(state, ready[0])
        return state

    def policy(self, state: MetaState) -> Policy:
        """Tubes around the exact trajectories, the best policy known elsewhere."""
        base = state.base.policy
        return base if state.tubes is None else TubePolicy(state.tubes, base)

    def value(self, state: MetaState) -> Value:
        """V that belongs to `policy`."""
        base = state.base.value
        return base if state.tubes is None else TubeValue(state.tubes, base)

    def _timely_grid(self, begun: float, asked: int, doubted: bool) -> int:
        """Nodes of the first grid before the deadline, for so many starts asked for; 0 for none.

        Unless loops are doubted, exact trajectories come before it, shared by the cores.
        """
        left = begun + (self.seconds or np.inf) - time.perf_counter()
        if not doubted:
            left -= asked * self.clock.expected(Step(start=0)) / self.cores
        return self.clock.first_grid(asked, left)

    def _look_ahead(self, state: MetaState) -> MetaState:
        """Have the other cores begin the next step or what comes after it.

        The next grid, if the last exact trajectory before it is left to this core; then those.
        """
        if self.cores < 2:
            return state
        grids, later = state.grids, next((s for s in state.pending[1:] if s.nodes), None)
        last = sum(not s.nodes for s in state.pending) <= LAST
        if later is not None and last and self._ends_in_time(state, later):
            grids = grids.begun([later.nodes], 1)
        exact = state.exact.begun(state.sought, self.cores + 1)
        return replace(state, grids=grids, exact=exact)

    def _ends_in_time(self, state: MetaState, step: Step) -> bool:
        return self.clock.expected(step, state.asked) <= self._seconds_left(state)

    def _seconds_left(self, state: MetaState) -> float:
        return state.begun + (self.seconds or np.inf) - time.perf_counter()

    def _ordered(self, state: MetaState) -> MetaState:
        """The state with the time that its next step will take.

        Under a deadline that is a grid which another core has finished, else the first step that
        ends in time; no grid is waited for as long as there is something to do here, and one not
        begun must leave time for a few exact trajectories, which buy more.
        """
        if not state.pending:
            return replace(state, next_seconds=0.0)
        first = state.pending[0]
        if self.seconds is not None:
            left = self._seconds_left(state)
            ready = (s for s in state.pending if s.nodes and state.grids.ready(s.nodes))
            here = sorted(state.pending, key=lambda s: s.nodes in state.grids.under_way)
            timely = (s for s in here if self._fits(state, s, left))
            first = next(ready, None) or next(timely, first)
            others = tuple(s for s in state.pending if s is not first)
            state = replace(state, pending=(first, *others))
        return replace(state, next_seconds=self._left(state, first))

    def _fits(self, state: MetaState, step: Step, left: float) -> bool:
        """Whether a step ends in so many seconds; a grid together with a few exact trajectories."""
        seconds = self._left(state, step)
        if step.nodes and step.nodes not in state.grids.under_way:
            exact = [s for s in state.pending if not s.nodes][:FEW]
            seconds += sum(self.clock.expected(s) for s in exact) / self.cores
        return seconds <= left

    def _is_ready(self, state: MetaState, step: Step) -> bool:
        """Whether another core has finished the step."""
        return state.grids.ready(step.nodes) or state.exact.ready(step.start)

    def _left(self, state: MetaState, step: Step) -> float:
        """Seconds until the step is done, if it is taken now."""
        if self._is_ready(state, step):
            return READY
        if step.nodes in state.grids.under_way:
            passed = time.perf_counter() - state.grids.since[step.nodes]
            return max(READY, self.clock.expected(step, state.asked) - passed)
        return self.clock.expected(step, state.asked)

    def _taken(self, state: MetaState, step: Step) -> MetaState:
        """The state after one of its pending steps."""
        state = replace(state, pending=tuple(s for s in state.pending if s is not step))
        return self._grid(state, step) if step.nodes else self._exact(state, step)

    def _grid(self, state: MetaState, step: Step) -> MetaState:
        """Take a grid; while another core solves it, exact trajectories are found here.

        Under a deadline these are steps of their own, and a grid that is late is left out.
        """
        nodes = step.nodes
        if nodes in state.grids.under_way:
            if self.seconds is None:
                exact = state.exact.computed(state.sought, lambda: state.grids.ready(nodes))
                state = replace(state, exact=exact)
            elif not state.grids.awaited(nodes, self._seconds_left(state)):
                return state
        answer, grids = state.grids.taken(nodes)
        self.clock.learn(step, answer.seconds, state.asked)
        return replace(state, grids=grids).with_grid(answer, nodes, self.suspicion)

    def _exact(self, state: MetaState, step: Step) -> MetaState:
        """The exact trajectory from a start, kept if it is the cheapest known from there."""
        query, i = state.query, step.start
        if i >= len(state.starts):
            own = sample_start(query, np.random.default_rng([i, len(state.query.obstacles)]))
            state = replace(
                state,
                starts=np.vstack([state.starts, own]),
                loops=(*state.loops, *network_loops(state.network, own[None], self.cores)),
                extremals=(*state.extremals, None),
            )
        if query.goal_distance(state.starts[i]) <= 0 or not state.is_to_be_sought(i):
            return state
        foreign, begun = state.exact.ready(i), time.perf_counter()
        if i >= state.asked:
            state = state.with_found(i, state.search(i).found())
        else:
            found, exact = state.exact.taken(i)
            state = replace(state, exact=exact).with_found(i, found)
        if not foreign:
            self.clock.learn(step, time.perf_counter() - begun)
        return state
