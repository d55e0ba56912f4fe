"""Backward characteristics: closed form, H = 0, and the value that shooting finds from them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from references import aligned_value

from ocp.compiled.batch import minimised_hamiltonians
from ocp.extremals.characteristics import backward_characteristics
from ocp.pontryagin import exact_trajectory
from ocp.query import Goal, Query
from ocp.query_family import paper_query

FREE = Query("unicycle", Goal((1.0, 1.0), 0.5))


def test_the_aligned_one_has_the_closed_form() -> None:
    fan = backward_characteristics(FREE, [[1.5, 1.0, 0.0]], 8.0)
    states, costates, costs = fan.points()
    distance = states[1:, 0] - 1.0
    exact = [aligned_value(d) for d in distance]
    assert_allclose(costs[1:], exact, rtol=1e-6, atol=1e-9)
    Q = np.tanh(1.5 * (distance**2 - 0.25))
    assert_allclose(costates[1:, 0], 2 * np.sqrt(Q), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("goal", [(4.0, 4.0), (0.0, 0.0), (1.0, 4.0)])
def test_hamiltonian_vanishes_and_costs_grow(goal: tuple[float, float]) -> None:
    query = paper_query(goal)
    angles = np.linspace(0.3, 6.0, 12)
    ends = np.column_stack([goal[0] + np.cos(angles), goal[1] + np.sin(angles), angles + 0.3])
    fan = backward_characteristics(query, ends, 6.0)
    states, costates, _ = fan.points()
    assert np.abs(minimised_hamiltonians(query, states, costates)).max() < 1e-6
    for costs, length in zip(fan.costs, fan.lengths, strict=True):
        assert (np.diff(costs[:length]) > 0).all()
        assert np.isnan(costs[length:]).all()
        assert costs[length - 2] <= 6.0 < costs[length - 1]


def test_points_near_the_goal_are_optimal() -> None:
    """Off the axis too: the exact trajectory from a point costs what the characteristic says."""
    fan = backward_characteristics(FREE, [[1.5, 1.0, 0.05], [1.0, 1.5, 1.2]], 2.0)
    for row, length in enumerate(fan.lengths):
        for k in (length // 2, length - 2):
            exact = exact_trajectory(FREE, fan.states[row, k])
            assert exact.cost == pytest.approx(fan.costs[row, k], rel=1e-6)
            assert exact.costates is not None
            assert_allclose(exact.costates[0], fan.costates[row, k], atol=1e-5)


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="ends"):
        backward_characteristics(FREE, [[1.5, 1.0]], 1.0)
    with pytest.raises(ValueError, match="cost_limit"):
        backward_characteristics(FREE, [[1.5, 1.0, 0.0]], -1.0)
    with pytest.raises(ValueError, match="max_points"):
        backward_characteristics(FREE, [[1.5, 1.0, 0.0]], 1.0, max_points=1)
