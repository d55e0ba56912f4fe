"""What is known of a query, and how a grid or an exact trajectory is taken into it."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from learning.adaptation.ahead import Ahead
from learning.adaptation.motions import GridAnswer, Loop, Search
from learning.adaptation.schedule import Step
from learning.conditioned.compiled_network import NetworkValue
from learning.conditioned.tube import Tubes
from ocp.extremals.extremal import Extremal
from ocp.query import Query
from ocp.value import Policy, Value

Floats = NDArray[np.float64]

DOUBT = 1.002  # two rough closed loops that are equally good differ in cost by less


@dataclass(frozen=True)
class Base:
    """What steers off the tubes: the network, or a grid.

    Attributes:
        policy: its policy.
        value: its value.
        costs: `[asked]`, of its closed loops; infinite where one does not arrive.
        nodes: of the grid; for a network, of a grid as good as it.
    """

    policy: Policy
    value: Value
    costs: Floats
    nodes: int

    def lost_and_spent(self, free: list[int]) -> tuple[int, float]:
        """How many closed loops from the starts `free` do not arrive, and what the others cost."""
        costs = self.costs[free]
        return int(np.isinf(costs).sum()), float(costs[np.isfinite(costs)].sum())


@dataclass(frozen=True)
class MetaState:
    """What is known of a query so far; see `ocp.planning.PlannerState`.

    Attributes:
        query: the query.
        network: its network's value.
        starts: `[k, n]`, those asked for, then those of the planner's own choice.
        asked: how many were asked for.
        begun: when, seconds of `time.perf_counter`.
        loops: the network's closed loop from each start; `None` if it does not get to the goal.
        bases: the network and all grids solved, any of which may steer off the tubes.
        pending: steps to come.
        exact: exact trajectories under way on other cores.
        grids: grids under way on other cores.
        extremals: the best exact trajectory from each start, or `None`.
        suspects: starts from which a grid's loop is in a better class of motions than what is
            known, or a better guess than one that led nowhere.
        tried: starts from which a search was made: the network's loop is no guess any more.
        grid: the last grid solved.
        trajectories: exact trajectories used.
        next_seconds: expected for the next step.
    """

    query: Query
    network: NetworkValue
    starts: Floats
    asked: int
    begun: float
    loops: tuple[Loop | None, ...]
    bases: tuple[Base, ...]
    pending: tuple[Step, ...]
    exact: Ahead[list[Extremal]]
    grids: Ahead[GridAnswer]
    extremals: tuple[Extremal | None, ...]
    suspects: frozenset[int] = frozenset()
    tried: frozenset[int] = frozenset()
    grid: GridAnswer | None = None
    trajectories: int = 0
    next_seconds: float = 0.0

    @property
    def finished(self) -> bool:
        return not self.pending

    def is_steered(self, i: int) -> bool:
        """Whether an exact trajectory leads from the i-th start, and no grid knows a better way."""
        return self.extremals[i] is not None and i not in self.suspects

    @cached_property
    def base(self) -> Base:
        """The best of those known, for the starts outside the tubes.

        The closed loops from these tell: more of them arrive, or all together they cost less, by
        more than such rough loops are wrong. Else the finest is.
        """
        finest = max(self.bases, key=lambda base: base.nodes)
        free = [i for i in range(self.asked) if not self.is_steered(i)]
        if not free:
            return finest

        def judged(base: Base) -> tuple[int, float]:
            lost, spent = base.lost_and_spent(free)
            return lost, spent if base is finest else spent * DOUBT

        return min([finest, *self.bases], key=judged)

    @cached_property
    def tubes(self) -> Tubes | None:
        """Around the exact trajectories found, if there are any."""
        steered = (i for i in range(len(self.starts)) if self.is_steered(i))
        solved = [e for i in steered if (e := self.extremals[i]) is not None]
        return Tubes.around(self.query, solved) if solved else None

    def search(self, i: int) -> Search:
        """For the exact trajectory from the i-th start."""
        doubted = i in self.suspects or self.loops[i] is None
        motion = self.grid.motions[i] if self.grid is not None and doubted else None
        loop = None if i in self.tried else self.loops[i]
        return Search(self.query, self.starts[i], loop, motion, self.extremals[i])

    def is_to_be_sought(self, i: int) -> bool:
        """Whether there is a guess from the i-th start that no search has used."""
        search = self.search(i)
        fresh = search.loop is not None and search.known is None
        return fresh or search.motion is not None

    @property
    def sought(self) -> list[int]:
        """The starts asked for whose searches are pending, in their order."""
        pending = (s.start for s in self.pending if not s.nodes and s.start < self.asked)
        return [i for i in pending if self.is_to_be_sought(i)]

    def with_searches(self) -> "MetaState":
        """With the searches from the starts asked for, with all that is known now.

        Those under way go on; from suspects they begin anew, for there is a better guess.
        """
        searches = tuple(self.search(i) for i in range(self.asked))
        left = self.exact.without(self.suspects)
        return replace(self, exact=replace(left, work=lambda i: searches[i].found()))

    def with_grid(self, answer: GridAnswer, nodes: int, suspicion: float) -> "MetaState":
        """With a grid of so many `nodes`; starts that it doubts are the next to be solved.

        Those are starts whose motion costs `suspicion` times as much as the grid's loop, dearest
        first, and those from which a search led nowhere.
        """
        outside = np.asarray(self.query.goal_distance(self.starts[: self.asked]) > 0)
        costs, known = np.where(outside, answer.costs, 0.0), self._known_costs()
        finite = outside & np.isfinite(costs)
        failed = [i in self.tried and self.extremals[i] is None for i in range(self.asked)]
        ratios = np.zeros(self.asked)
        ratios[finite] = np.where(failed, np.inf, known)[finite] / costs[finite]
        doubted = ratios > suspicion
        suspects = [int(i) for i in np.argsort(-ratios, kind="stable") if doubted[i]]
        pending = (
            *(Step(start=i) for i in suspects),
            *(step for step in self.pending if step.start not in suspects),
        )
        base = Base(answer.policy, answer.solution.value, costs, nodes)
        state = replace(
            self,
            suspects=frozenset(suspects),
            grid=answer,
            bases=(*self.bases, base),
            pending=pending,
        )
        return state.with_searches()

    def with_found(self, i: int, found: list[Extremal]) -> "MetaState":
        """With what a search from the i-th start has found; the cheapest counts."""
        known = self.extremals[i]
        candidates = found if known is None else [*found, known]
        best = min(candidates, key=lambda extremal: extremal.cost)
        extremals = list(self.extremals)
        extremals[i] = best if best.trajectory is not None else None
        return replace(
            self,
            extremals=tuple(extremals),
            suspects=self.suspects - {i},
            tried=self.tried | {i},
            trajectories=self.trajectories + any(e.trajectory is not None for e in found),
        )

    def _known_costs(self) -> Floats:
        """Of the cheapest motion known from each start asked for, a grid's apart."""
        asked = slice(0, self.asked)
        return np.array(
            [
                extremal.cost if extremal is not None else loop.cost if loop else np.inf
                for loop, extremal in zip(self.loops[asked], self.extremals[asked], strict=True)
            ]
        )


def unknown(i: int) -> list[Extremal]:
    """The work of a search before anything is known."""
    raise AssertionError(f"start {i}: nothing is known yet")
