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
from learning.adaptation.schedule import COARSE, FEW, READY, Clock, Step, steps
from learning.adaptation.state import MetaState, unknown
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
        seconds: the deadline that plans will be given, if one. Then finer grids follow the exact
            trajectories as long as they end in time, and whatever is ready first is used first.
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
    clock: Clock = field(default_factory=Clock)

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
        encoder = QueryEncoder.of(query)
        chosen = next((p for p in self.networks if p.knows(query)), None)
        if chosen is None:
            raise SolveError(Status.NOT_APPLICABLE, "the network was trained on other queries")
        network = NetworkValue(encoder, chosen.weights)
        rows = np.array(starts, dtype=float).reshape(-1, query.system.n)
        pending = steps(len(rows), self.grids, self.seconds is not None)
        loops = network_loops(network, rows, self.cores)
        costs = np.array([np.inf if loop is None else loop.cost for loop in loops])
        state = MetaState(
            query,
            network,
            rows,
            len(rows),
            begun,
            loops,
            (NetworkPolicy(network), network),
            np.where(query.goal_distance(rows) > 0, costs, 0.0),
            chosen.worth_nodes,
            pending,
            Ahead(unknown),
            Ahead(partial(solved_grid, query, rows)),
            (None,) * len(rows),
        )
        state = state.with_searches()
        if self.grids and np.isinf(state.base_costs).any():
            state = self._grid(state, COARSE)
        return self._ordered(state)

    def refine(self, state: MetaState) -> MetaState:
        """One exact trajectory or one grid more."""
        if state.finished:
            return state
        step, *rest = state.pending
        foreign = step.nodes in state.grids.under_way or state.exact.ready(step.start)
        begun = time.perf_counter()
        state = self._look_ahead(replace(state, pending=tuple(rest)), step)
        state = self._grid(state, step.nodes) if step.nodes else self._exact(state, step.start)
        if not foreign:
            self.clock.learn(step, time.perf_counter() - begun, state.asked)
        return self._ordered(state)

    def policy(self, state: MetaState) -> Policy:
        """Tubes around the exact trajectories, the best policy known elsewhere."""
        return state.base[0] if state.tubes is None else TubePolicy(state.tubes, state.base[0])

    def value(self, state: MetaState) -> Value:
        """V that belongs to `policy`."""
        return state.base[1] if state.tubes is None else TubeValue(state.tubes, state.base[1])

    def _look_ahead(self, state: MetaState, step: Step) -> MetaState:
        """Have the other cores begin `step` or what comes after it.

        The next grid, if few exact trajectories are left to this core before it; then those.
        """
        if self.cores < 2:
            return state
        exact = [s.start for s in (step, *state.pending) if not s.nodes]
        grids, later = state.grids, next((s for s in state.pending if s.nodes), None)
        if later is not None and len(exact) <= FEW and self._ends_in_time(state, later):
            grids = grids.begun([later.nodes], 1)
        known = (i for i in exact if i < state.asked and state.is_to_be_sought(i))
        return replace(state, grids=grids, exact=state.exact.begun(known, self.cores + 1))

    def _ends_in_time(self, state: MetaState, step: Step) -> bool:
        passed = time.perf_counter() - state.begun
        return passed + self.clock.expected(step, state.asked) <= (self.seconds or np.inf)

    def _ordered(self, state: MetaState) -> MetaState:
        """The state with the time that its next step will take.

        Under a deadline that is a grid which another core has finished, else the first step that
        ends in time; a grid must leave time for a few exact trajectories, which buy more.
        """
        if not state.pending:
            return replace(state, next_seconds=0.0)
        first = state.pending[0]
        if self.seconds is not None:
            left = state.begun + self.seconds - time.perf_counter()
            ready = (s for s in state.pending if s.nodes and state.grids.ready(s.nodes))
            timely = (s for s in state.pending if self._fits(state, s, left))
            first = next(ready, None) or next(timely, first)
            others = tuple(s for s in state.pending if s is not first)
            state = replace(state, pending=(first, *others))
        return replace(state, next_seconds=self._left(state, first))

    def _fits(self, state: MetaState, step: Step, left: float) -> bool:
        """Whether a step ends in so many seconds; a grid together with a few exact trajectories."""
        seconds = self._left(state, step)
        if step.nodes:
            exact = [s for s in state.pending if not s.nodes][:FEW]
            seconds += sum(self.clock.expected(s) for s in exact) / self.cores
        return seconds <= left

    def _left(self, state: MetaState, step: Step) -> float:
        """Seconds until the step is done, if it is taken now."""
        if state.grids.ready(step.nodes) or state.exact.ready(step.start):
            return READY
        expected = self.clock.expected(step, state.asked)
        if step.nodes in state.grids.under_way:
            passed = time.perf_counter() - state.grids.since[step.nodes]
            return max(READY, expected - passed)
        return expected

    def _grid(self, state: MetaState, nodes: int) -> MetaState:
        """Solve a grid."""
        answer, grids = state.grids.taken(nodes)
        return replace(state, grids=grids).with_grid(answer, nodes, self.suspicion)

    def _exact(self, state: MetaState, i: int) -> MetaState:
        """The exact trajectory from the i-th start, kept if it is the cheapest known from there."""
        query = state.query
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
        if i >= state.asked:
            return state.with_found(i, state.search(i).found())
        found, exact = state.exact.taken(i)
        return replace(state, exact=exact).with_found(i, found)
