"""The main method: the policy of a network that knows the query, then better ones while time lasts.

A conditioned network answers in a millisecond. Its own closed loops are the guesses from which
exact trajectories are found; around each a tube of neighbouring extremals steers. Grids, coarse
ones first, replace the network as the policy off the tubes where they are known to be better, and
tell where the network chose the wrong class of motions. While one step is taken, the exact
trajectories to come are computed on the machine's other cores.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from learning.ahead import Ahead
from learning.conditioned.compiled_network import NetworkPolicy, NetworkValue
from learning.conditioned.pretrained_weights import Pretrained, load_pretrained
from learning.conditioned.query_encoder import QueryEncoder
from learning.conditioned.tube import TubePolicy, Tubes, TubeValue
from ocp.eikonal import solve_eikonal
from ocp.extremals.extremal import Extremal, find_extremal
from ocp.extremals.warm_start import rollouts, timed
from ocp.grid import Grid
from ocp.planning import Plan, Until, plan
from ocp.query import Query
from ocp.query_family import sample_start
from ocp.threads import usable_cores, warm_workers
from ocp.trajectory import SolveError, Status, Trajectory
from ocp.value import Policy, Value

Floats = NDArray[np.float64]

STRIDE = 0.15  # metres or radians: a step of the network's own closed loop
MOST_STEPS = 400
MANY = 4  # starts whose loops are worth another core
MARGIN = 0.5  # metres of the grids beyond the domain
TRAJECTORIES = 8  # exact ones, from states of its own choice if no starts are asked for
GRIDS = (4_500, 18_000, 60_000, 240_000)
EARLY = 4  # so many starts are solved exactly before any grid
CAUTION = 1.3  # by how much a step's expected time is overestimated
OUTLIER = 4.0  # a step's time counts for at most so many times what was expected
SUSPICION = 1.01  # an extremal that costs so many times a grid's value is in the wrong class


@dataclass(frozen=True)
class Step:
    """One refinement: an exact trajectory from the start with this number, or a grid."""

    start: int = -1
    nodes: int = 0


@dataclass(frozen=True)
class Loop:
    """A closed loop of the network, as `NetworkValue.drive` left it.

    Attributes:
        path: `[k + 1, 7]`, up to the first state in the goal.
        cost: about its cost.
    """

    path: Floats
    cost: float

    def motion(self, query: Query) -> Trajectory:
        """The loop as a guess."""
        n, m = query.system.n, query.system.m
        moved = self.path[:-1]
        return timed(query, self.path[:, :n], moved[:, n + m], moved[:, n : n + m])


@dataclass
class Clock:
    """How long steps take on this machine, learned as they are taken."""

    trajectory: float = 4e-3
    grid: float = 2.5e-3
    node: float = 0.6e-6

    def expected(self, step: Step) -> float:
        """Seconds, with caution."""
        if step.nodes:
            return CAUTION * (self.grid + self.node * step.nodes)
        return CAUTION * self.trajectory

    def learn(self, step: Step, seconds: float) -> None:
        """Take note of a step's time.

        An outlier counts in part only: the first step also loads code, and whoever believed that
        time would never take a step before a deadline again, and so never learn better.
        """
        seconds = min(seconds, OUTLIER * self.expected(step) / CAUTION)
        if step.nodes:
            self.node += 0.5 * (max(seconds - self.grid, 0.0) / step.nodes - self.node)
        else:
            self.trajectory += 0.3 * (seconds - self.trajectory)


@dataclass(frozen=True)
class MetaState:
    """What is known of a query so far; see `ocp.planning.PlannerState`.

    Attributes:
        query: the query.
        network: its network's value.
        starts: `[k, n]`, those asked for, then those of the planner's own choice.
        asked: how many were asked for.
        loops: the network's closed loop from each start; `None` if it does not get to the goal.
        suspects: starts from which a grid seems to know a better class of motions.
        extremals: the best exact trajectory from each start, or `None`.
        base: policy and value off the tubes.
        nodes: of the grid behind `base`; 0 if it is the network's.
        grid_policy: of the last grid solved.
        pending: steps to come.
        worth_nodes: of a grid as good as the network.
        ahead: exact trajectories beside the network's loops, under way on other cores.
        trajectories: exact trajectories used.
        next_seconds: expected for the next step.
    """

    query: Query
    network: NetworkValue
    starts: Floats
    asked: int
    loops: tuple[Loop | None, ...]
    base: tuple[Policy, Value]
    pending: tuple[Step, ...]
    worth_nodes: int
    ahead: Ahead[Extremal]
    extremals: tuple[Extremal | None, ...] = ()
    suspects: frozenset[int] = frozenset()
    nodes: int = 0
    grid_policy: Policy | None = None
    trajectories: int = 0
    next_seconds: float = 0.0

    @property
    def finished(self) -> bool:
        return not self.pending

    @cached_property
    def tubes(self) -> Tubes | None:
        """Around the exact trajectories found, if there are any."""
        solved = [e for e in self.extremals if e is not None]
        return Tubes.around(self.query, solved) if solved else None


@dataclass(frozen=True)
class MetaPlanner:
    """A `Planner` on a trained network.

    Attributes:
        networks: the first that knows a query is used for it.
        grids: whether to use grids at all; without, only network and exact trajectories.
        patient: whether finer grids follow the exact trajectories from the few starts asked for:
            for plans with a deadline, which use the time they have.
        cores: that it may occupy. The answer does not depend on how many, only its time does.
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
    patient: bool = False
    cores: int = field(default_factory=usable_cores)
    clock: Clock = field(default_factory=Clock)

    @classmethod
    def pretrained(cls, name: str, grids: bool = True, patient: bool = False) -> "MetaPlanner":
        """The planner on shipped weights, `paper` or `general`.

        Raises:
            ValueError: if there are no such weights, or they are damaged.
        """
        return cls((load_pretrained(name),), grids, patient)

    @classmethod
    def shipped(cls, grids: bool = True, patient: bool = False) -> "MetaPlanner":
        """The planner on all shipped weights, each used for the queries that it knows best."""
        return cls((load_pretrained("paper"), load_pretrained("general")), grids, patient)

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
        encoder = QueryEncoder.of(query)
        chosen = next((p for p in self.networks if p.knows(query)), None)
        if chosen is None:
            raise SolveError(Status.NOT_APPLICABLE, "the network was trained on other queries")
        network = NetworkValue(encoder, chosen.weights)
        rows = np.array(starts, dtype=float).reshape(-1, query.system.n)
        loops = _loops(network, rows, self.cores)
        state = MetaState(
            query,
            network,
            rows,
            len(rows),
            loops,
            (NetworkPolicy(network), network),
            self._steps(len(rows), chosen.worth_nodes),
            chosen.worth_nodes,
            Ahead(partial(_beside, query, rows, loops)),
            (None,) * len(rows),
        )
        if self.grids and any(x is None for x in loops):
            state = self._grid(state, GRIDS[0])
            state = replace(state, pending=tuple(s for s in state.pending if s.nodes != GRIDS[0]))
        return self._timed(state)

    def _steps(self, asked: int, worth_nodes: int) -> tuple[Step, ...]:
        """Small steps first; a coarse grid at least, to tell a wrong class of motions."""
        allowed = GRIDS if self.grids else ()
        useful = [n for n in allowed if n > worth_nodes or n == GRIDS[0]]
        exact = [Step(start=i) for i in range(asked)]
        more = [Step(start=i) for i in range(TRAJECTORIES)]
        small = [Step(nodes=n) for n in useful if n <= 18_000]
        large = [Step(nodes=n) for n in useful if n > 18_000]
        if asked == 0:
            return (*small, *more, *large)
        if self.patient:
            # No policy is read from a grid that the network is worth, but a class of motions is.
            large = [Step(nodes=n) for n in allowed if Step(nodes=n) not in small]
        elif asked <= TRAJECTORIES:
            large = []  # exact trajectories leave a finer grid little to gain
        return (*exact, *small, *large) if asked <= EARLY else (*small, *exact, *large)

    def refine(self, state: MetaState) -> MetaState:
        """One exact trajectory or one grid more."""
        if state.finished:
            return state
        step, *rest = state.pending
        ready = state.ahead.ready(step.start)
        begun = time.perf_counter()
        state = self._look_ahead(replace(state, pending=tuple(rest)), step)
        state = self._grid(state, step.nodes) if step.nodes else self._exact(state, step.start)
        if not ready:
            self.clock.learn(step, time.perf_counter() - begun)
        return self._timed(state)

    def _look_ahead(self, state: MetaState, step: Step) -> MetaState:
        """Have the other cores begin the exact trajectories of `step` and of the next ones."""
        if self.cores < 2:
            return state
        exact = (s.start for s in (step, *state.pending) if not s.nodes)
        known = (i for i in exact if i < state.asked and _beside_is_to_come(state, i))
        return replace(state, ahead=state.ahead.begun(known, self.cores + 1))

    def policy(self, state: MetaState) -> Policy:
        """Tubes around the exact trajectories, the best policy known elsewhere."""
        return state.base[0] if state.tubes is None else TubePolicy(state.tubes, state.base[0])

    def value(self, state: MetaState) -> Value:
        """V that belongs to `policy`."""
        return state.base[1] if state.tubes is None else TubeValue(state.tubes, state.base[1])

    def _timed(self, state: MetaState) -> MetaState:
        expected = self.clock.expected(state.pending[0]) if state.pending else 0.0
        return replace(state, next_seconds=expected)

    def _grid(self, state: MetaState, nodes: int) -> MetaState:
        """Solve a grid; starts that it knows cheaper motions from are the next to be solved."""
        query = state.query
        solution = solve_eikonal(query, Grid.for_query(query, nodes, MARGIN))
        policy, value = solution.policy(), solution.value
        known = np.array(
            [
                extremal.cost if extremal is not None else loop.cost if loop else np.inf
                for loop, extremal in zip(state.loops, state.extremals, strict=True)
            ]
        )
        dearer = known / np.maximum(np.asarray(value.value(state.starts)), 1e-9)
        dearest = (int(i) for i in np.argsort(-dearer, kind="stable"))
        suspects = [i for i in dearest if dearer[i] > SUSPICION]
        failed = any(loop is None for loop in state.loops)
        better = failed or nodes > state.worth_nodes
        return replace(
            state,
            suspects=frozenset(suspects),
            base=(policy, value) if better else state.base,
            nodes=nodes if better else state.nodes,
            grid_policy=policy,
            pending=(
                *(Step(start=i) for i in suspects),
                *(step for step in state.pending if step.start not in suspects),
            ),
        )

    def _exact(self, state: MetaState, i: int) -> MetaState:
        """The exact trajectory from the i-th start, kept if it is the cheapest known from there."""
        query = state.query
        if i >= len(state.starts):
            own = sample_start(query, np.random.default_rng([i, len(state.query.obstacles)]))
            state = replace(
                state,
                starts=np.vstack([state.starts, own]),
                loops=(*state.loops, *_loops(state.network, own[None], self.cores)),
                extremals=(*state.extremals, None),
            )
        if query.goal_distance(state.starts[i]) <= 0:
            return state
        found: list[Extremal] = []
        # The grid's guess first: the search beside the network's loop is under way elsewhere.
        if state.grid_policy is not None and (i in state.suspects or state.loops[i] is None):
            guess = rollouts(query, state.grid_policy, state.starts[i])[0]
            if guess is not None:
                found.append(find_extremal(query, state.starts[i], guess))
        if _beside_is_to_come(state, i):
            if i < state.asked:
                beside, ahead = state.ahead.taken(i)
                state = replace(state, ahead=ahead)
            else:
                beside = _beside(query, state.starts, state.loops, i)
            found.append(beside)
        if not found:
            return state
        known = state.extremals[i]
        candidates = found if known is None else [*found, known]
        best = min(candidates, key=lambda extremal: extremal.cost)
        extremals = list(state.extremals)
        extremals[i] = best if best.trajectory is not None else None
        return replace(
            state,
            extremals=tuple(extremals),
            suspects=state.suspects - {i},
            trajectories=state.trajectories + any(e.trajectory is not None for e in found),
        )


def _beside_is_to_come(state: MetaState, i: int) -> bool:
    """Whether the exact trajectory beside the network's loop from the i-th start is unknown."""
    return state.loops[i] is not None and state.extremals[i] is None


def _beside(query: Query, starts: Floats, loops: tuple[Loop | None, ...], i: int) -> Extremal:
    """The extremal from the i-th start beside the network's closed loop."""
    loop = loops[i]
    assert loop is not None  # nothing else is begun ahead
    return find_extremal(query, starts[i], loop.motion(query))


def _loops(network: NetworkValue, starts: Floats, cores: int) -> tuple[Loop | None, ...]:
    """The closed loops of a network's policy; `None` where one does not get to the goal.

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
    return (*drive(starts[:half]), *other.result())
