"""Exact motions: as good as collocation's, their values what they cost, hard starts included."""

import numpy as np
import pytest

from learning.causality_free.exact import (
    TAIL,
    closed_loops,
    continued,
    exact_from,
    exact_trajectories,
)
from learning.causality_free.families import FAMILIES, get_family, merging_car
from ocp.compiled.batch import minimised_hamiltonians
from ocp.cost import RunningCost
from ocp.query import Equilibrium, Query
from ocp.regulation import RegulatorValue, solve_regulation

EVERY = pytest.mark.parametrize("family", FAMILIES.values(), ids=list(FAMILIES))


@EVERY
def test_costs_agree_with_collocation(family) -> None:
    """Collocation knows nothing of costates; its replayed cost is known to 1e-5."""
    rng = np.random.default_rng(0)
    query = family.sample(rng)
    start = family.starts(query, 1, rng)[0]
    found = exact_trajectories(query, [RegulatorValue(query)], start)[0]
    assert found is not None
    assert found.cost == pytest.approx(solve_regulation(query, start).cost, rel=2e-4)


@EVERY
def test_values_and_costates_solve_the_hamilton_jacobi_equation(family) -> None:
    rng = np.random.default_rng(1)
    query = family.sample(rng)
    starts = family.starts(query, 4, rng)
    found = [o for o in exact_trajectories(query, [RegulatorValue(query)], starts) if o is not None]
    assert len(found) >= (3 if query.obstacles else 4)  # among obstacles one may have no answer
    for optimum in found:
        motion = optimum.motion
        assert motion.costates is not None
        H = minimised_hamiltonians(query, motion.states, motion.costates)
        # H is constant, and what the linear regulator's tail leaves of it is of third order there.
        assert np.abs(H).max() < 0.5 * TAIL * optimum.cost
        assert (np.diff(optimum.values) < 0).all()
        tail = float(RegulatorValue(query).value(motion.states[-1]))
        assert optimum.values[-1] == pytest.approx(tail, rel=1e-9)
        assert tail <= 5 * TAIL * optimum.cost


def test_a_linear_robots_motion_costs_what_riccati_says() -> None:
    cost = RunningCost(goal=0.0, state=tuple(map(tuple, np.eye(4).tolist())), input=(0.5, 0.5))
    query = Query("double-integrator-2d", Equilibrium((0.0,) * 4, 0.1), cost=cost)
    value = RegulatorValue(query)
    starts = np.random.default_rng(2).uniform(-1, 1, (3, 4))
    for start, found in zip(starts, exact_trajectories(query, [value], starts), strict=True):
        assert found is not None
        assert found.cost == pytest.approx(float(value.value(start)), rel=1e-7)
        assert found.motion.costates is not None
        slope = value.gradient(found.motion.states)
        assert np.allclose(found.motion.costates, slope, rtol=1e-6, atol=1e-6)


def test_continuation_gets_where_the_regulators_loop_does_not() -> None:
    """Near the slot but turned away, the linear regulator turns the wheels across the car."""
    query = merging_car([2.0, 2.0, 0.5, 0.3, 0.3], [0.15, 0.15], [2.0, 1.5])
    start = query.reference + np.array([0.7, 2.2, 0.9, 0.0, 0.2])
    guess = closed_loops(query, RegulatorValue(query), start)[0]
    assert guess is None or exact_from(query, guess) is None
    found = continued(query, start)
    assert found is not None
    assert np.array_equal(found.motion.states[0], start)
    assert found.cost == pytest.approx(solve_regulation(query, start).cost, rel=2e-3)


def test_loops_that_diverge_are_no_guesses() -> None:
    """A value that pushes away from the goal leads nowhere, and says so."""
    family = get_family("car")
    query = family.sample(np.random.default_rng(3))
    honest = RegulatorValue(query)

    class Repelling:
        def value(self, states):
            return honest.value(states)

        def gradient(self, states):
            return -honest.gradient(states)

    starts = family.starts(query, 3, np.random.default_rng(4))
    assert closed_loops(query, Repelling(), starts) == [None] * 3
    assert exact_trajectories(query, [Repelling()], starts, continuation=False) == [None] * 3
