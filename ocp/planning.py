"""Planners and the one driver: refine until a stopping rule holds.

A planner is a start, a step and an answer. A one-shot method is a planner of one step. Stopping
rules compose with `|` (either ends it) and know nothing of the method.
"""

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.query import Query
from ocp.threads import in_time
from ocp.value import Policy, Value

log = logging.getLogger(__name__)

DOUBT = 2.5  # a step may take so many times as long as expected
HAND_OVER = 1e-3  # seconds, a tenth of a short deadline: what giving up a late step takes


@dataclass(frozen=True)
class Progress:
    """What a stopping rule may look at before the next refinement.

    Attributes:
        seconds: time spent so far and expected for the next refinement.
        iterations: refinements done.
        trajectories: exact trajectories used.
    """

    seconds: float
    iterations: int
    trajectories: int


@dataclass(frozen=True)
class Until:
    """A stopping rule.

    Attributes:
        satisfied: whether to stop rather than to begin the next refinement.
        seconds: after the query; a refinement under way is then given up.
    """

    satisfied: Callable[[Progress], bool]
    seconds: float = math.inf

    def __or__(self, other: "Until") -> "Until":
        return Until(
            lambda p: self.satisfied(p) or other.satisfied(p), min(self.seconds, other.seconds)
        )


def deadline(seconds: float) -> Until:
    """Stop rather than begin a refinement that would end more than `seconds` after the query.

    One that takes longer than foreseen is given up: the answer is the best one before it.

    Raises:
        ValueError: if `seconds` is not positive.
    """
    if not seconds > 0:
        raise ValueError(f"deadline: must be a positive number of seconds, got {seconds}")
    return Until(lambda p: p.seconds >= seconds, seconds)


def never() -> Until:
    """No end but the planner's own: until there is nothing left to refine."""
    return Until(lambda _: False)


def iterations(count: int) -> Until:
    """Stop after `count` refinements.

    Raises:
        ValueError: if `count` is negative.
    """
    if count < 0:
        raise ValueError(f"iterations: must not be negative, got {count}")
    return Until(lambda p: p.iterations >= count)


def trajectories(count: int) -> Until:
    """Stop once the planner has used `count` exact trajectories.

    Raises:
        ValueError: if `count` is negative.
    """
    if count < 0:
        raise ValueError(f"trajectories: must not be negative, got {count}")
    return Until(lambda p: p.trajectories >= count)


class PlannerState(Protocol):
    """The state of a planner always holds the best valid answer so far."""

    @property
    def finished(self) -> bool:
        """Whether another refinement could not improve the answer."""
        ...

    @property
    def trajectories(self) -> int:
        """Exact trajectories used so far."""
        ...

    @property
    def next_seconds(self) -> float:
        """Expected time of the next refinement; 0 if unknown."""
        ...


class Planner(Protocol):
    """A planning method.

    Laws: `start` already gives a state with a valid answer; `refine` never makes it worse by the
    planner's own measure and does not change its argument.
    """

    def start(self, query: Query, starts: Sequence[NDArray[np.float64]]) -> Any:
        """The first state. `starts` `[n]` are those that matter; none means the whole space."""
        ...

    def refine(self, state: Any) -> Any:
        """A better state."""
        ...

    def policy(self, state: Any) -> Policy:
        """The feedback policy of the state."""
        ...

    def value(self, state: Any) -> Value:
        """The cost-to-go the policy was read from."""
        ...


@runtime_checkable
class Settles(Protocol):
    """A planner that works on several cores, and at a deadline takes up what they have done."""

    def settled(self, state: Any) -> Any:
        """The state with all that is ready; nothing is computed or waited for."""
        ...


Answer = tuple[Policy, Value]


@dataclass(frozen=True)
class OneShotState:
    """The answer of a method that has nothing to refine."""

    answer: Answer
    finished: bool = True
    trajectories: int = 0
    next_seconds: float = 0.0


@dataclass(frozen=True)
class OneShot:
    """A method that answers in one step, as a planner."""

    solve: Callable[[Query, Sequence[NDArray[np.float64]]], Answer]

    def start(self, query: Query, starts: Sequence[NDArray[np.float64]]) -> OneShotState:
        return OneShotState(self.solve(query, starts))

    def refine(self, state: OneShotState) -> OneShotState:
        return state

    def policy(self, state: OneShotState) -> Policy:
        return state.answer[0]

    def value(self, state: OneShotState) -> Value:
        return state.answer[1]


@dataclass(frozen=True)
class Plan:
    """A planner's answer to a query.

    Attributes:
        query: what was asked.
        policy: the feedback policy.
        value: the method's cost-to-go.
        reaction_time: seconds from the query in memory to the policy ready.
        trajectories: exact trajectories used.
    """

    query: Query
    policy: Policy
    value: Value
    reaction_time: float
    trajectories: int


def plan(
    planner: Planner,
    query: Query,
    starts: Sequence[ArrayLike] = (),
    until: Until | None = None,
) -> Plan:
    """Run `planner` on `query` until the rule holds or nothing more is to be gained.

    `starts` are states `[n]` that matter most; with none, all do.

    Raises:
        ValueError: if a start does not fit the query.
        SolveError: if the planner found no answer.
    """
    checked = [query.check_start(s) for s in starts]
    until = until or iterations(8)
    begun = time.perf_counter()
    work = _Refinement(planner, until, begun, planner.start(query, checked))
    work.run(late=False)
    due = begun + until.seconds - min(HAND_OVER, 0.1 * until.seconds)
    if not work.is_over and in_time(work.run, due - time.perf_counter()) is None:
        work.given_up = True
        log.info("refinement %d is late and left out", work.done + 1)
    state = work.state
    if work.given_up and isinstance(planner, Settles):
        state = planner.settled(state)
    policy, value = planner.policy(state), planner.value(state)
    return Plan(query, policy, value, time.perf_counter() - begun, state.trajectories)


@dataclass
class _Refinement:
    """The loop of `plan`: on the caller's thread, but for steps that may end after a deadline.

    These are left to one thread beside, which the caller can give up waiting for. It is not used
    for all: a thread just woken is often put on the core that already works for the planner.

    Attributes:
        state: the best so far.
        done: refinements.
        given_up: nobody waits any more.
    """

    planner: Planner
    until: Until
    begun: float
    state: Any
    done: int = 0
    given_up: bool = False

    @property
    def is_over(self) -> bool:
        """Whether the rule holds or nothing more is to be gained."""
        return self.given_up or self.state.finished or self._is_enough()

    def run(self, late: bool = True) -> bool:
        """Refine until it is over or, unless steps may be `late`, one may be; true at the end."""
        while not self.is_over and (late or not self._may_be_late()):
            better = self.planner.refine(self.state)
            if not self.given_up:
                self.state = better
                self.done += 1
        return True

    def _may_be_late(self) -> bool:
        if self.until.seconds == math.inf:
            return False
        left = self.begun + self.until.seconds - time.perf_counter()
        return self.state.next_seconds == 0 or left < DOUBT * self.state.next_seconds

    def _is_enough(self) -> bool:
        seconds = time.perf_counter() - self.begun + self.state.next_seconds
        return self.until.satisfied(Progress(seconds, self.done, self.state.trajectories))
