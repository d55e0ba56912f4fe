"""The driver: stopping rules compose, refinements never outlast a deadline by design."""

import threading
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from ocp.planning import OneShot, Progress, deadline, iterations, plan, trajectories
from ocp.query import Goal, Query

QUERY = Query("single-integrator-1d", Goal((0.0,), 0.5))


@dataclass(frozen=True)
class State:
    steps: int = 0
    next_seconds: float = 0.0
    last: int = 100

    @property
    def finished(self) -> bool:
        return self.steps >= self.last

    @property
    def trajectories(self) -> int:
        return 2 * self.steps


@dataclass(frozen=True)
class Counter:
    """A planner whose answer is the number of its refinements."""

    first: State

    def start(self, query, starts):
        assert isinstance(query, Query)
        assert all(isinstance(s, np.ndarray) for s in starts)
        return self.first

    def refine(self, state):
        return replace(state, steps=state.steps + 1)

    def policy(self, state) -> Any:
        return state.steps

    def value(self, state) -> Any:
        return state.steps


def steps(until, first: State = State()) -> Any:
    return plan(Counter(first), QUERY, [np.array([1.0])], until).policy


def test_iterations_trajectories_and_exhaustion_end_a_plan() -> None:
    assert steps(iterations(0)) == 0
    assert steps(iterations(5)) == 5
    assert steps(trajectories(8)) == 4
    assert steps(iterations(10**6), State(last=7)) == 7


def test_either_of_two_rules_ends_a_plan() -> None:
    assert steps(iterations(5) | trajectories(4)) == 2
    assert steps(iterations(1) | trajectories(4)) == 1
    assert steps(deadline(1e6) | iterations(3)) == 3


def test_a_refinement_that_would_outlast_the_deadline_is_not_begun() -> None:
    assert steps(deadline(1.0) | iterations(3), State(next_seconds=2.0)) == 0
    assert deadline(1.0).satisfied(Progress(1.0, 0, 0))
    assert not deadline(1.0).satisfied(Progress(0.999, 0, 0))


def test_a_refinement_that_is_late_is_not_waited_for() -> None:
    """It ends only once the answer is there, and the answer is the one before it."""
    answered = threading.Event()

    class Stuck(Counter):
        def refine(self, state):
            if state.steps == 2:
                assert answered.wait(60)
            return super().refine(state)

    result: Any = plan(Stuck(State()), QUERY, [np.array([1.0])], deadline(0.3))
    answered.set()
    assert result.policy == 2


def test_what_is_ready_at_the_deadline_is_taken_up() -> None:
    answered = threading.Event()

    class Settling(Counter):
        def refine(self, state):
            assert answered.wait(60)
            return super().refine(state)

        def settled(self, state):
            return replace(state, steps=state.steps + 10)

    result: Any = plan(Settling(State()), QUERY, [np.array([1.0])], deadline(0.1))
    answered.set()
    assert result.policy == 10


def test_only_steps_that_may_be_late_are_taken_on_another_thread() -> None:
    here, threads = threading.get_ident(), []

    class Told(Counter):
        def refine(self, state):
            threads.append(threading.get_ident())
            return super().refine(state)

    for next_seconds, same in ((1.0, True), (40.0, False), (0.0, False)):
        threads.clear()
        first = State(next_seconds=next_seconds, last=3)
        plan(Told(first), QUERY, [np.array([1.0])], deadline(60.0))
        assert len(threads) == 3
        assert [t == here for t in threads] == [same] * 3


def test_an_error_of_a_refinement_is_the_caller_s_also_before_a_deadline() -> None:
    class Failing(Counter):
        def refine(self, state):  # noqa: ARG002
            raise TimeoutError("the planner's own")

    for until in (deadline(60.0), iterations(1)):
        with pytest.raises(TimeoutError, match="own"):
            plan(Failing(State()), QUERY, [np.array([1.0])], until)


def test_a_one_shot_method_is_a_planner_of_one_step() -> None:
    answer: Any = ("policy", "value")
    result = plan(OneShot(lambda _query, starts: answer * len(starts)), QUERY, [[1.0]])
    assert (result.policy, result.value) == answer
    assert result.trajectories == 0
    assert result.reaction_time > 0


def test_bad_arguments_are_refused_before_any_work() -> None:
    with pytest.raises(ValueError, match="deadline: must be a positive"):
        deadline(0.0)
    with pytest.raises(ValueError, match="iterations: must not be negative"):
        iterations(-1)
    with pytest.raises(ValueError, match="trajectories: must not be negative"):
        trajectories(-1)

    def never(_query, _starts):
        raise AssertionError("solved before the start was checked")

    with pytest.raises(ValueError, match="start: x = 9 m lies outside"):
        plan(OneShot(never), QUERY, [[9.0]])
