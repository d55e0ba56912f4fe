"""The planner: a trained value, exact trajectories of the query at hand, an adapted value.

The first answer is the trained network's. Every refinement solves a few trajectories exactly, half
of them from where the present value's Hamilton-Jacobi residual is largest, and refits the last
layer to all known so far.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from learning.causality_free.adaptation import adapt, guard_score
from learning.causality_free.exact import Optimum, exact_trajectories
from learning.causality_free.families import RegulationFamily
from learning.causality_free.pretrained import Pretrained, load_pretrained, pretrained_for
from learning.causality_free.residual import largest
from learning.causality_free.samples import Samples
from learning.causality_free.value import NetworkValue
from ocp.planning import Plan, Until, plan, trajectories
from ocp.query import Query
from ocp.value import GreedyPolicy, greedy

Floats = NDArray[np.float64]

TRAJECTORIES = 16  # exact ones in all
BATCH = 8  # trajectories a refinement: their closed loops are advanced together
CANDIDATES = 128  # states held against the residual in each refinement
HELD_OUT = 256  # states of the adaptation's guard
NEW, GUARD = 1, 2  # streams of random numbers


@dataclass(frozen=True)
class CausalityFreeState:
    """What is known of a query so far; see `ocp.planning.PlannerState`.

    Attributes:
        query: the query.
        family: that it is of.
        trained: the network's value.
        value: the best so far: the trained one, or an adapted one.
        score: its mean log(1 + Hamilton-Jacobi residual) at the held-out states.
        held_out: `[k, n]`.
        pending: `[k, n]`, starts that were asked for and are not solved yet.
        optima: the exact trajectories.
        asked: how many trajectories were tried.
        most: how many are wanted; twice as many are tried at most.
        next_seconds: 0: not known.
    """

    query: Query
    family: RegulationFamily
    trained: NetworkValue
    value: NetworkValue
    score: float
    held_out: Floats
    pending: Floats
    optima: tuple[Optimum, ...] = ()
    asked: int = 0
    most: int = TRAJECTORIES
    next_seconds: float = 0.0

    @property
    def trajectories(self) -> int:
        return len(self.optima)

    @property
    def finished(self) -> bool:
        return len(self.optima) >= self.most or self.asked >= 2 * self.most


@dataclass(frozen=True)
class CausalityFreePlanner:
    """A `Planner` on a trained network.

    Attributes:
        network: the network; `None` takes the shipped one that knows the query.
        most: exact trajectories in all. Starts that the closed loops do not solve are replaced,
            rather than grown by continuation, which takes ten times as long.
        seed: of starts and held-out states.
    """

    network: Pretrained | None = None
    most: int = TRAJECTORIES
    seed: int = 0

    @classmethod
    def pretrained(cls, name: str) -> "CausalityFreePlanner":
        """The planner on the shipped weights of a family.

        Raises:
            ValueError: if there are no such weights, or they are damaged.
        """
        return cls(load_pretrained(name))

    def plan(
        self, query: Query, starts: Sequence[ArrayLike] = (), until: Until | None = None
    ) -> Plan:
        """`ocp.plan` for the starts `[n]` with this planner, by default to its last trajectory.

        Raises:
            ValueError: if a start does not fit.
            SolveError: NOT_APPLICABLE if no network knows such a query.
        """
        return plan(self, query, starts, until or trajectories(self.most))

    def start(self, query: Query, starts: Sequence[Floats]) -> CausalityFreeState:
        """The network's value as trained; `starts` `[n]` matter most.

        Raises:
            SolveError: NOT_APPLICABLE if no network knows such a query.
        """
        network = self.network or pretrained_for(query)
        value = network.value(query)
        held_out = network.family.starts(query, HELD_OUT, np.random.default_rng([self.seed, GUARD]))
        asked_for = np.array(starts, dtype=float).reshape(-1, query.system.n)
        score = guard_score(value, held_out)
        return CausalityFreeState(
            query, network.family, value, value, score, held_out, asked_for, most=self.most
        )

    def refine(self, state: CausalityFreeState) -> CausalityFreeState:
        """A few exact trajectories more, and the last layer refitted to all of them."""
        if state.finished:
            return state
        count = min(BATCH, state.most - len(state.optima))
        starts = self._starts(state, count)
        found = exact_trajectories(state.query, [state.value], starts, continuation=False)
        optima = (*state.optima, *(optimum for optimum in found if optimum is not None))
        state = replace(
            state, optima=optima, asked=state.asked + count, pending=state.pending[count:]
        )
        if not optima:
            return state
        adapted = adapt(state.trained, Samples.of(state.query, optima), state.held_out)
        if adapted.after >= state.score:
            return state
        return replace(state, value=adapted.value, score=adapted.after)

    def policy(self, state: CausalityFreeState) -> GreedyPolicy:
        """Greedy for the best value so far."""
        return greedy(state.query, state.value)

    def value(self, state: CausalityFreeState) -> NetworkValue:
        """The best value so far."""
        return state.value

    def _starts(self, state: CausalityFreeState, count: int) -> Floats:
        """`[count, n]`: those asked for; then half by the residual, half at random."""
        first = state.pending[:count]
        left = count - len(first)
        rng = np.random.default_rng([self.seed, NEW, state.asked])
        candidates = state.family.starts(state.query, CANDIDATES, rng)
        picked = largest(state.query, state.value, candidates, left - left // 2)
        others = state.family.starts(state.query, left // 2, rng)
        return np.concatenate([first, picked, others])
