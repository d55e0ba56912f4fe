"""The linear regulator's closed loop from the nodes of a grid: an upper bound of V."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.testing import assert_allclose

from ocp.cost import RunningCost
from ocp.grid import Grid
from ocp.grids.regulator_loop import STEP, regulator_costs
from ocp.models.linear import double_integrator
from ocp.obstacle import Obstacle
from ocp.query import Equilibrium, Query
from ocp.regulation import RegulatorValue
from ocp.value import greedy
from sims.closed_loop import LoopSettings, rollouts

QUERIES = Path(__file__).parents[3] / "sims/queries"
PENDULUM = Query.load(QUERIES / "pendulum.toml")
GRID = Grid.of(PENDULUM.system, (21, 25))
COSTS = regulator_costs(PENDULUM, GRID)


def test_of_a_linear_robot_it_is_the_quadratic_form() -> None:
    goal, cost = Equilibrium((0.0, 0.0), 0.1), ((2.0, 0.0), (0.0, 1.0))
    weights = RunningCost(goal=0.0, state=cost, input=(0.5,))
    query = Query(double_integrator(1), goal, cost=weights)
    grid = Grid.of(query.system, (9, 9))
    costs, expected = regulator_costs(query, grid), RegulatorValue(query).value(grid.nodes())
    inner = np.isfinite(costs)
    assert inner.sum() > 20  # from others it would leave the box for a while
    assert_allclose(costs[inner], expected[inner], rtol=1e-3)  # held inputs cost more
    assert (costs[inner] >= expected[inner] * (1 - 1e-9)).all()


def test_of_a_pendulum_it_is_what_the_closed_loop_costs_or_infinite_where_it_cannot_lift() -> None:
    policy = greedy(PENDULUM, RegulatorValue(PENDULUM))
    rng = np.random.default_rng(0)
    nodes, costs = GRID.nodes().reshape(-1, 2), COSTS.ravel()
    inside = (np.abs(nodes) < 0.9 * np.array(GRID.upper)).all(axis=1)
    chosen = rng.choice(np.flatnonzero(np.isfinite(costs) & inside), 20, replace=False)
    loops = rollouts(policy, list(nodes[chosen]), LoopSettings(period=STEP, substeps=1))
    assert all(loop.reached for loop in loops)
    # The rollout adds x'P x from the region on, where it is exact to second order.
    measured = np.array([loop.cost for loop in loops], dtype=float)
    assert_allclose(costs[chosen], measured, rtol=2e-3)
    hanging = np.argmin(np.abs(nodes).sum(axis=1))
    assert np.isinf(costs[hanging])


def test_beside_hard_obstacles_it_bounds_nothing() -> None:
    cart = Query.load(QUERIES / "cart-pole.toml")
    grid = Grid.of(cart.system, (3, 9, 3, 3))
    assert np.isfinite(regulator_costs(cart, grid)).any()
    walled = replace(cart, obstacles=(Obstacle.circle((2.0,), 0.1, hard=True),))
    assert np.isinf(regulator_costs(walled, grid)).all()
