"""A ladder of grids against a deadline, on a clock of the test's own."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ocp.eikonal import NODES, solve_eikonal
from ocp.eikonal_planner import LADDER, EikonalPlanner, reaches
from ocp.obstacle import Obstacle
from ocp.query import Goal, Query
from ocp.query_family import PAPER_START, paper_query

QUERY = paper_query((4.0, 4.0))
START = np.array(PAPER_START)


@dataclass
class Laboratory:
    """Solves and checks that take the time they are told to, and solve nothing.

    Attributes:
        pace: how many times the ladder's usual time a solve takes.
        check_seconds: what a check takes.
        misses: sizes whose policy fails its check.
        jitter: by how much each solve's time is multiplied, in turn.
    """

    pace: float = 1.0
    check_seconds: float = 0.002
    misses: tuple[int, ...] = ()
    jitter: tuple[float, ...] = ()
    now: float = 100.0
    solved: list[int] = field(default_factory=list)

    def clock(self) -> float:
        return self.now

    def solve(self, _query: Query, nodes: int) -> Any:
        factor = self.jitter[len(self.solved) % len(self.jitter)] if self.jitter else 1.0
        self.now += LADDER[nodes] * self.pace * factor
        self.solved.append(nodes)
        return FakeSolution(nodes)

    def check(self, _query: Query, policy: Any, _starts: Any) -> bool:
        self.now += self.check_seconds
        return policy not in self.misses

    def plan(self, seconds: float | None, starts: tuple = (START,)) -> Any:
        """The driver's loop, on this clock."""
        planner = EikonalPlanner(seconds, self.clock, self.solve, self.check)
        begun = self.now
        state = planner.start(QUERY, starts)
        while not state.finished and (
            seconds is None or self.now - begun + state.next_seconds < seconds
        ):
            state = planner.refine(state)
        self.elapsed = self.now - begun
        return state


@dataclass(frozen=True)
class FakeSolution:
    nodes: int

    def policy(self) -> int:
        return self.nodes


@given(
    seconds=st.floats(0.005, 2.0),
    pace=st.floats(0.3, 4.0),
    check=st.floats(1e-4, 0.05),
    jitter=st.lists(st.floats(0.8, 1.0), min_size=1, max_size=4),
)
def test_the_deadline_is_kept_at_any_pace(
    seconds: float, pace: float, check: float, jitter: list[float]
) -> None:
    """Solves take up to a fifth more than the last one's pace says; the caution is a quarter.

    Only the first solve (and the first check, not yet measured) may outlast the deadline.
    """
    laboratory = Laboratory(pace, check, jitter=tuple(jitter))
    laboratory.plan(seconds)
    first = LADDER[min(LADDER)] * pace + check
    assert laboratory.elapsed <= max(seconds, first) + check


def test_the_largest_grid_that_fits_is_chosen_at_once() -> None:
    """No time goes to sizes in between."""
    laboratory = Laboratory()
    state = laboratory.plan(0.06)
    assert laboratory.solved == [4_500, 60_000]
    assert state.policy == 60_000
    assert state.checked


def test_a_slow_machine_gets_a_smaller_grid() -> None:
    sizes = []
    for pace in (0.5, 1.0, 2.0, 4.0):
        laboratory = Laboratory(pace)
        laboratory.plan(0.1)
        sizes.append(max(laboratory.solved))
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] > sizes[-1]


def test_no_time_means_the_smallest_grid() -> None:
    laboratory = Laboratory()
    state = laboratory.plan(0.001)
    assert laboratory.solved == [min(LADDER)]
    assert state.finished


def test_without_a_deadline_one_grid_of_the_default_size_is_solved() -> None:
    laboratory = Laboratory()
    state = laboratory.plan(None)
    assert laboratory.solved == [NODES]
    assert state.finished


def test_a_policy_that_misses_the_goal_never_replaces_one_that_reaches_it() -> None:
    laboratory = Laboratory(misses=(60_000, 120_000, 240_000))
    state = laboratory.plan(10.0)
    assert state.policy not in laboratory.misses
    assert state.checked
    assert max(laboratory.solved) == 240_000


def test_a_first_policy_that_misses_is_replaced_and_said() -> None:
    laboratory = Laboratory(misses=(4_500,))
    assert laboratory.plan(1.0).checked
    laboratory = Laboratory(misses=tuple(LADDER))
    state = laboratory.plan(1.0)
    assert not state.checked


def test_without_starts_nothing_is_checked() -> None:
    laboratory = Laboratory(check_seconds=1e9)
    state = laboratory.plan(1.0, starts=())
    assert laboratory.elapsed < 1.0
    assert state.policy == max(laboratory.solved)


def test_a_deadline_that_is_none_is_refused() -> None:
    for seconds in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="seconds"):
            EikonalPlanner(seconds)


def test_the_real_ladder_ends_at_a_grid_of_the_size_it_says() -> None:
    planner = EikonalPlanner(1e6)
    state = planner.start(QUERY, [START])
    assert state.solution.grid.size == pytest.approx(min(LADDER), rel=0.25)
    assert state.checked
    for _ in range(2):
        state = planner.refine(state)
    assert state.finished
    assert state.solution.grid.size == pytest.approx(max(LADDER), rel=0.05)
    assert float(planner.value(state).value(START)) == pytest.approx(23.29976, rel=5e-3)
    assert planner.policy(state)(START).shape == (2,)


def test_the_check_sees_the_goal_and_hard_obstacles() -> None:
    policy = solve_eikonal(QUERY, nodes=4500).policy()
    assert reaches(QUERY, policy, [START])
    assert reaches(QUERY, policy, [np.array([4.0, 4.0, 0.0])])
    wall = Obstacle.circle((0.0, 0.0), 1.5, hard=True)
    walled = Query("unicycle", Goal((4.0, 4.0), 0.5), (wall,))
    assert not reaches(walled, policy, [np.array([-4.0, -4.0, np.pi / 4])])
