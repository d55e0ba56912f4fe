"""Fast marching: laws of the scheme on any robot, hard obstacles, input that is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from marching_problems import half, steered

from ocp.compiled.batch import state_costs
from ocp.cost import RunningCost
from ocp.grid import Grid
from ocp.grids import march_kernels
from ocp.grids.fast_marching import march, marched, relaxation
from ocp.grids.goal_table import goal_table
from ocp.grids.selling_stencil import relaxed_metrics, selling_stencil
from ocp.models import MODELS
from ocp.obstacle import Obstacle
from ocp.query import Goal, Query
from ocp.trajectory import SolveError, Status

GENERAL = Query(
    "unicycle",
    Goal((1.5, -0.5), 0.6),
    (Obstacle.circle((-1.0, 1.0), 0.9), Obstacle.diamond((-2.0, 2.0), 0.8)),
    RunningCost(),
)
TIME_FREE = [
    name
    for name, system in ((name, make()) for name, make in MODELS.items())
    if not system.has_drift
    and (q := Query(name, Goal((0.5,) * len(system.position), 0.6))).is_time_free
]


def small_problem(name: str, hard: bool = False) -> tuple[Query, Grid]:
    d = len(MODELS[name]().position)
    obstacle = Obstacle.circle((-1.5,) * d, 1.0, hard=hard)
    query = Query(name, Goal((0.5,) * d, 0.6), (obstacle,))
    return query, Grid.for_query(query, 4000)


@pytest.mark.parametrize("name", TIME_FREE)
@pytest.mark.parametrize("seed", [True, False])
def test_nodes_are_accepted_in_the_order_of_their_values(name, seed):
    """Of first order; second-order values may be out of order by as much as they differ from it."""
    query, grid = small_problem(name)
    result = marched(query, grid, order=1, seed=seed)
    accepted = result.values.ravel()[result.accepted]
    assert (np.diff(accepted) >= -1e-12 * accepted[1:]).all()
    assert len(set(result.accepted.tolist())) == len(result.accepted)
    assert np.isfinite(result.values).all()


@pytest.mark.parametrize("name", TIME_FREE)
def test_first_order_values_solve_the_scheme_at_every_node(name):
    """An independent look: the left side at the result, against 4 W."""
    query, grid = small_problem(name)
    result = marched(query, grid, order=1, seed=False)
    s = selling_stencil(query, grid, relaxation(grid))
    left, _ = np.zeros((2, s.entry.size))
    march_kernels.schemes(
        s.padded(result.values, np.inf), s.entry, s.count, s.weights, s.near, s.far, False, left, _
    )
    right = 4 * state_costs(query, grid.nodes())
    residual = s.unpadded(left).ravel() - right.ravel()
    assert abs(residual[result.accepted]).max() < 1e-8 * right.max()


@pytest.mark.parametrize("name", TIME_FREE)
def test_the_same_input_gives_the_same_bits(name):
    query, grid = small_problem(name)
    assert np.array_equal(march(query, grid), march(query, grid))


places = st.tuples(st.floats(-4, 4), st.floats(-4, 4))


@settings(max_examples=15)
@given(places, st.floats(0.2, 1.2), st.booleans(), st.booleans())
def test_more_cost_never_lowers_the_value(place, radius, hard, seed):
    """The scheme of first order is monotone, with and without the table."""
    grid = half(GENERAL, 23, 23, 8)
    before = march(GENERAL, grid, order=1, seed=seed)
    more = replace(GENERAL, obstacles=(*GENERAL.obstacles, Obstacle.circle(place, radius, hard)))
    assert (march(more, grid, order=1, seed=seed) >= before - 1e-9 * before).all()
    heavier = replace(GENERAL, cost=RunningCost(obstacle=1.0 + radius))
    assert (march(heavier, grid, order=1, seed=seed) >= before - 1e-9 * before).all()


@settings(max_examples=15)
@given(places, st.floats(0.3, 0.8), places, st.floats(0.4, 1.2))
def test_it_is_at_least_the_value_without_obstacles(goal, goal_radius, place, radius):
    query = Query("unicycle", Goal(goal, goal_radius), (Obstacle.circle(place, radius),))
    grid = half(query, 23, 23, 8)
    floor = goal_table(query, 14.0).value(grid.nodes())
    assert (march(query, grid, order=1) >= floor * (1 - 1e-9) - 1e-9).all()


def test_with_a_free_robot_the_relaxation_does_not_matter():
    query, grid = small_problem("single-integrator-2d")
    assert np.array_equal(march(query, grid, relaxation=0.05), march(query, grid, relaxation=1.0))


def test_the_unicycle_s_metric_is_relaxed_across_its_heading_only():
    headings = np.linspace(-np.pi, np.pi, 7, endpoint=False)
    states = np.column_stack([0 * headings, 0 * headings, headings])
    query = Query("unicycle", Goal((0.0, 0.0), 0.5), cost=RunningCost(input=(0.25, 4.0)))
    n = np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    t = np.stack([-n[:, 1], n[:, 0]], axis=-1)
    expected = np.zeros((7, 3, 3))
    expected[:, :2, :2] = 4.0 * (n[:, :, None] * n[:, None] + 0.3**2 * t[:, :, None] * t[:, None])
    expected[:, 2, 2] = 0.25
    assert np.allclose(relaxed_metrics(query, states, 0.3), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", TIME_FREE)
def test_the_stencil_s_weights_give_the_metric_in_cells(name):
    query, grid = small_problem(name)
    eps = relaxation(grid)
    s = selling_stencil(query, grid, eps)
    assert (s.weights >= 0).all()
    # The metric at each entry: the entry of the node with that index along the table's axes.
    entry = s.entry.reshape(s.shape)[s.core].ravel()
    _, first = np.unique(entry, return_index=True)
    states = grid.nodes().reshape(-1, grid.dimension)[first]
    D = relaxed_metrics(query, states, eps) / np.multiply.outer(grid.spacing, grid.spacing)
    form = np.einsum("kf,kfi,kfj->kij", s.weights, s.offsets, s.offsets)
    assert np.allclose(form, D, atol=1e-8 * abs(D).max())


# Hard obstacles


@pytest.mark.parametrize("name", ["unicycle", "single-integrator-2d"])
@pytest.mark.parametrize("seed", [True, False])
@pytest.mark.parametrize("order", [1, 2])
def test_a_wall_thinner_than_any_cell_blocks(name, seed, order):
    """No node lies in it, and offsets of several cells would reach across."""
    wall = Obstacle.polygon([(-2.02, -7), (-2.0, -7), (-0.5, 7), (-0.52, 7)], hard=True)
    query = Query(name, Goal((2.0, -1.0), 0.5), (wall,), RunningCost(obstacle=0.0))
    grid = Grid.for_query(query, 12_000)
    values = march(query, grid, seed=seed, order=order)
    nodes = grid.nodes()
    middle = -1.26 + 1.5 * nodes[..., 1] / 14
    assert np.isinf(values[nodes[..., 0] < middle - 0.1]).all()
    assert np.isfinite(values[nodes[..., 0] > middle + 0.5]).all()


@pytest.mark.parametrize("name", ["unicycle", "single-integrator-2d"])
def test_a_gap_lets_the_robot_through_unless_it_is_too_big(name):
    walls = tuple(
        Obstacle.polygon([(-0.05, a), (0.05, a), (0.05, b), (-0.05, b)], hard=True)
        for a, b in ((-7, 1.0), (2.4, 7))
    )
    query = Query(name, Goal((2.5, -1.0), 0.5), walls, RunningCost(obstacle=0.0))
    grid = Grid.for_query(query, 20_000)
    open_world = march(replace(query, obstacles=()), grid)
    through = march(query, grid)
    left = grid.nodes()[..., 0] < -0.5
    assert np.isfinite(through[left]).all()
    assert (through[left] >= open_world[left] * 0.99).all()
    assert np.median(through[left] / open_world[left]) > 1.05
    stout = march(replace(query, robot_radius=0.75), grid)
    assert np.isinf(stout[left]).all()


def test_inside_a_hard_obstacle_there_is_no_value():
    query, grid = small_problem("unicycle", hard=True)
    values = march(query, grid)
    inside = query.clearance(grid.nodes(), hard_only=True) < 0
    assert inside.any()
    assert np.isinf(values[inside]).all()
    assert np.isfinite(values[~inside]).mean() > 0.999


# What is refused


@pytest.mark.parametrize(
    "query",
    [
        Query("double-integrator-1d", Goal((0.0,), 0.5)),
        replace(GENERAL, input_lower=(-1.0, -1.0)),
    ],
    ids=["drift", "bounds"],
)
def test_queries_that_are_not_time_free_are_refused(query):
    with pytest.raises(SolveError, match="no drift and no input bounds") as caught:
        march(query, Grid.of(query.system, (9,) * query.system.n))
    assert caught.value.status is Status.NOT_APPLICABLE


def test_a_coordinate_that_no_input_moves_is_refused():
    query = Query(steered([[1.0, 0.0], [0.0, 0.0]]), Goal((0.0, 0.0), 0.5))
    with pytest.raises(SolveError, match="no input of steered moves x1"):
        march(query, Grid.of(query.system, (9, 9)))


def test_four_states_are_refused():
    query = Query(steered(np.eye(4)), Goal((0.0,) * 4, 0.5))
    with pytest.raises(SolveError, match="1 to 3 states"):
        march(query, Grid.of(query.system, (5,) * 4))


def test_bad_arguments_are_refused():
    grid = half(GENERAL, 15, 15, 6)
    with pytest.raises(ValueError, match="order: must be 1 or 2, got 3"):
        march(GENERAL, grid, order=3)
    for wrong in (0.0, -0.1, 1.5, math.nan):
        with pytest.raises(ValueError, match="relaxation: must lie in"):
            march(GENERAL, grid, relaxation=wrong)
    with pytest.raises(ValueError, match="grid: unicycle has 3 states"):
        march(GENERAL, Grid((-5.0, -5.0), (5.0, 5.0), (9, 9), (False, False)))
    third = Grid((-5.0, -5.0, 0.0), (5.0, 5.0, 2.0), (9, 9, 9), (False, False, True))
    with pytest.raises(ValueError, match="axis heading cannot be periodic over 2 rad"):
        march(GENERAL, third)
    coarse = Grid.of(GENERAL.system, (4, 4, 6))
    with pytest.raises(ValueError, match="too coarse"):
        march(replace(GENERAL, goal=Goal((0.0, 0.0), 0.1)), coarse, seed=False)


def test_the_relaxation_follows_its_rule():
    system = GENERAL.system
    for cells in (16, 49, 100):
        whole = Grid.of(system, (cells + 1, cells + 1, cells // 2))
        part = Grid.of(system, (cells + 1, cells + 1, cells // 4), half_turn=True)
        assert relaxation(whole) == relaxation(part) == pytest.approx(1.4 / math.sqrt(cells))
    assert relaxation(Grid.of(MODELS["single-integrator-1d"](), (3,))) <= 1.0
