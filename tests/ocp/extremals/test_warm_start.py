"""Rough motions: the closed loops of policies, and motions cut at the goal."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import ArrayLike, NDArray

from ocp.eikonal import solve_eikonal
from ocp.extremals.warm_start import rollouts, until_goal
from ocp.grids.lookahead import LookaheadPolicy
from ocp.pontryagin import exact_trajectory
from ocp.query import Query
from ocp.query_family import PAPER_START, paper_query

QUERY = paper_query((1.0, 4.0))
STARTS = np.array([PAPER_START, (3.0, -2.0, 2.0), (1.0, 4.0, 0.0), (-6.0, 1.0, 3.1)])


@dataclass(frozen=True)
class Wrapped:
    """A lookahead that does not show itself, so that it is stepped by calling it."""

    inner: LookaheadPolicy

    @property
    def query(self) -> Query:
        return self.inner.query

    def __call__(self, states: ArrayLike) -> NDArray[np.float64]:
        return self.inner(states)


@dataclass(frozen=True)
class Standing:
    query: Query

    def __call__(self, states: ArrayLike) -> NDArray[np.float64]:
        return np.zeros((*np.shape(states)[:-1], self.query.system.m))


def test_a_lookahead_driven_in_one_compiled_call_moves_as_if_it_were_stepped() -> None:
    policy = solve_eikonal(QUERY).policy()
    assert isinstance(policy, LookaheadPolicy)
    together = rollouts(QUERY, policy, STARTS)
    stepped = rollouts(QUERY, Wrapped(policy), STARTS)
    assert [m is None for m in together] == [False, False, True, False]  # the third is in the goal
    for a, b in zip(together, stepped, strict=True):
        if a is None or b is None:
            assert a is b
            continue
        for name in ("times", "states", "inputs", "cost_so_far"):
            assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-9, atol=1e-9)


def test_a_robot_that_stands_gets_nowhere() -> None:
    """A time-free step has its length whatever the input: with none at all it never arrives."""
    assert rollouts(QUERY, Standing(QUERY), [PAPER_START]) == [None]


@pytest.mark.parametrize("every", [1, 8])
def test_a_motion_is_cut_where_it_enters_the_goal(every: int) -> None:
    motion = exact_trajectory(QUERY, PAPER_START)
    assert motion.costates is not None

    def prolonged(column: NDArray[np.float64]) -> NDArray[np.float64]:
        """One more step like the last eight together, into the goal."""
        return np.concatenate([column[::every], [2 * column[-1] - column[-9]]])

    further = replace(
        motion,
        times=prolonged(motion.times),
        states=prolonged(motion.states),
        inputs=prolonged(motion.inputs),
        costates=prolonged(motion.costates),
        cost_so_far=prolonged(motion.cost_so_far),
    )
    cut = until_goal(QUERY, further)
    assert abs(QUERY.goal_distance(cut.states[-1])) < 1e-3 * QUERY.goal.radius
    assert (QUERY.goal_distance(cut.states[:-1]) > 0).all()
    assert cut.duration == pytest.approx(motion.duration, rel=1e-3)
    assert cut.cost == pytest.approx(motion.cost, rel=1e-3)
    assert cut.costates is not None
    assert cut.states.shape == cut.costates.shape == (len(cut.times), 3)
