"""Semi-Lagrangian sweeps for the time-free form."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from references import TABLE_ONE_OPTIMA, aligned_value

from ocp.cost import RunningCost
from ocp.grid import Grid, GridValue
from ocp.grids.goal_table import goal_table
from ocp.grids.semi_lagrangian import TOLERANCE, sweep_time_free
from ocp.obstacle import Obstacle
from ocp.query import Goal, Query
from ocp.query_family import PAPER_START, paper_query
from ocp.trajectory import SolveError, Status

PLAIN = Query("unicycle", Goal((1.0, 1.0), 0.5))
SMALL = Grid.for_query(PLAIN, 4000)


def solved(query: Query, grid: Grid = SMALL) -> GridValue:
    return GridValue(grid, sweep_time_free(query, grid).checked().values)


def random_states(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform((-4.5, -4.5, -np.pi), (4.5, 4.5, np.pi), (count, 3))


def slope(spacings: list[float], errors: list[float]) -> float:
    return float(np.polyfit(np.log(spacings), np.log(errors), 1)[0])


def test_first_order_off_axis_against_the_exact_value() -> None:
    """Random states: straight drives alone would not see the error made sideways."""
    states = random_states(2000)
    states = states[PLAIN.goal_distance(states) > 0.3]
    exact = goal_table(PLAIN, 10.0).value(states)
    spacings, errors = [], []
    for nodes in (4_000, 13_500, 45_000, 150_000):
        grid = Grid.for_query(PLAIN, nodes)
        excess = solved(PLAIN, grid).value(states) / exact - 1
        spacings.append(float(grid.spacing[0]))
        errors.append(float(np.median(abs(excess))))
    assert 0.9 < slope(spacings, errors) < 1.4
    assert 0.005 < errors[-1] < 0.015


def test_a_point_robots_value_is_that_of_its_distance() -> None:
    """p' = u moves straight at the goal: the closed form holds everywhere, and to first order."""
    query = Query("single-integrator-2d", Goal((0.5, 0.3), 0.5))
    spacings, errors = [], []
    for nodes in (1_000, 4_000, 16_000, 64_000):
        grid = Grid.for_query(query, nodes)
        distance = query.goal_distance(grid.nodes()) + 0.5
        table = np.linspace(0.5, 9.0, 400)
        exact = np.interp(distance, table, [aligned_value(d) for d in table])
        spacings.append(float(grid.spacing[0]))
        errors.append(float(abs(solved(query, grid).values - exact)[distance > 0.7].max()))
    assert 0.7 < slope(spacings, errors) < 1.3
    assert errors[-1] < 0.06


@pytest.mark.parametrize(("d", "nodes", "bound"), [(1, 60, 0.02), (3, 40_000, 0.25)])
def test_other_dimensions(d: int, nodes: int, bound: float) -> None:
    query = Query(f"single-integrator-{d}d", Goal((0.5,) * d, 0.5))
    grid = Grid.for_query(query, nodes)
    distance = query.goal_distance(grid.nodes()) + 0.5
    table = np.linspace(0.5, 10.0, 400)
    exact = np.interp(distance, table, [aligned_value(r) for r in table])
    excess = (solved(query, grid).values - exact)[distance > 0.5]
    assert -bound / 20 < excess.min() <= excess.max() < bound


def test_straight_drives_of_the_unicycle() -> None:
    """Facing the goal or away from it, V is the closed form."""
    value = solved(PLAIN, Grid.for_query(PLAIN, 60_000))
    angles = np.linspace(0.1, 6.2, 25)
    for distance in (1.0, 2.5, 3.9):
        exact = aligned_value(distance)
        x = 1 + distance * np.cos(angles)
        y = 1 + distance * np.sin(angles)
        facing = value.value(np.column_stack([x, y, angles + np.pi]))
        away = value.value(np.column_stack([x, y, angles]))
        np.testing.assert_allclose(facing, away, atol=1e-9)
        assert 0 < (facing - exact).min() <= (facing - exact).max() < 0.02 + 0.025 * distance


@pytest.mark.parametrize("goal", TABLE_ONE_OPTIMA)
def test_the_papers_queries(goal: tuple[float, float]) -> None:
    query = paper_query(goal)
    found = float(solved(query, Grid.for_query(query, 60_000)).value(PAPER_START))
    assert -0.005 < found / TABLE_ONE_OPTIMA[goal] - 1 < 0.015


def test_half_the_headings_give_the_values_of_all() -> None:
    query = paper_query((1.0, 4.0))
    full = solved(query, Grid.of(query.system, (21, 21, 16))).values
    half = solved(query, Grid.of(query.system, (21, 21, 8), half_turn=True)).values
    np.testing.assert_allclose(full[..., :8], full[..., 8:], atol=5 * TOLERANCE)
    np.testing.assert_allclose(full[..., :8], half, atol=5 * TOLERANCE)


def test_it_is_a_fixed_point() -> None:
    query = paper_query((1.0, 4.0))
    once = sweep_time_free(query, SMALL, tolerance=1e-9)
    again = sweep_time_free(query, SMALL, upper_bound=once.values, tolerance=1e-9)
    np.testing.assert_allclose(again.values, once.values, atol=1e-8)
    assert again.updates <= SMALL.size
    rough = sweep_time_free(query, SMALL, tolerance=1e-2)
    assert 0 <= (rough.values - once.values).max() < 3e-2


@settings(max_examples=5)
@given(st.floats(0.3, 4.0))
def test_input_weights_scale_the_value(weight: float) -> None:
    """V is the integral of 2 sqrt(W) times the R-norm of the input."""
    heavy = replace(PLAIN, cost=RunningCost(input=(weight, weight)))
    np.testing.assert_allclose(
        solved(heavy).values, np.sqrt(weight) * solved(PLAIN).values, rtol=1e-4, atol=1e-3
    )


coordinate = st.floats(-4.5, 4.5)


@settings(max_examples=15)
@given(coordinate, coordinate, st.floats(0.2, 1.2), coordinate, coordinate)
@example(0.5003650522865106, -2.0569355592290863, 0.879181533021365, 3.41686056, -3.92207006)
def test_an_obstacle_never_lowers_the_value(x: float, y: float, r: float, gx: float, gy: float):
    free = replace(PLAIN, goal=Goal((gx, gy), 0.6))
    soft = replace(free, obstacles=(Obstacle.circle((x, y), r),))
    hard = replace(free, obstacles=(Obstacle.circle((x, y), r, hard=True),))
    without, with_soft = solved(free).values, solved(soft).values
    assert (with_soft >= without - 2 * TOLERANCE).all()
    if np.hypot(x - gx, y - gy) > r + 0.6 + 3 * SMALL.spacing[0]:  # else it may close the goal
        with_hard = solved(hard).values
        assert (with_hard >= with_soft - 2 * TOLERANCE).all()
        inside = hard.clearance(SMALL.nodes(), hard_only=True) < 0
        assert np.isinf(with_hard[inside]).all()


@settings(max_examples=15)
@given(coordinate, coordinate, st.floats(0.5, 1.0), st.floats(0.0, 0.5))
def test_a_larger_goal_never_raises_the_value(x: float, y: float, radius: float, more: float):
    small = solved(replace(PLAIN, goal=Goal((x, y), radius))).values
    large = solved(replace(PLAIN, goal=Goal((x, y), radius + more))).values
    assert (large <= small + 1e-2).all()  # the way into the ball is searched for, not exact


def test_walls_thinner_than_a_cell_enclose() -> None:
    """A closed box of walls 3 cm thick on a grid of 40 cm: nothing outside has a finite value."""
    bars = [
        [(0, 0), (0.03, 0), (0.03, 3), (0, 3)],
        [(0, 0), (3, 0), (3, 0.03), (0, 0.03)],
        [(2.97, 0), (3, 0), (3, 3), (2.97, 3)],
        [(0, 2.97), (3, 2.97), (3, 3), (0, 3)],
    ]
    walls = tuple(Obstacle.polygon(bar, hard=True) for bar in bars)
    cost = RunningCost(obstacle=0.0)
    query = Query("unicycle", Goal((1.5, 1.5), 0.5), walls, cost)
    values = solved(query).values
    position = SMALL.nodes()[..., :2]
    inside = ((position > 0.03) & (position < 2.97)).all(axis=-1)
    assert np.isfinite(values[inside]).all()
    assert np.isinf(values[~inside]).all()


def test_the_robots_radius_counts() -> None:
    gap = (
        Obstacle.polygon([(-1, -6), (-0.8, -6), (-0.8, -0.6), (-1, -0.6)], hard=True),
        Obstacle.polygon([(-1, 0.6), (-0.8, 0.6), (-0.8, 6), (-1, 6)], hard=True),
    )
    query = Query("unicycle", Goal((2.0, 0.0), 0.5), gap, RunningCost(obstacle=0.0))
    grid = Grid.for_query(query, 15_000)
    assert np.isfinite(solved(query, grid).value([-3.0, 0.0, 0.0]))
    assert np.isinf(solved(replace(query, robot_radius=0.65), grid).value([-3.0, 0.0, 0.0]))


def test_an_upper_bound_is_kept() -> None:
    bound = np.full(SMALL.shape, 5.0)
    values = sweep_time_free(PLAIN, SMALL, upper_bound=bound).values
    assert values.max() <= 5.0
    free = solved(PLAIN).values
    np.testing.assert_allclose(values, np.minimum(free, 5.0), atol=2 * TOLERANCE)


def test_an_unfinished_iteration_says_so() -> None:
    result = sweep_time_free(PLAIN, SMALL, max_sweeps=2)
    assert result.status is Status.NOT_CONVERGED
    with pytest.raises(SolveError, match="did not converge"):
        result.checked()
    assert (result.values >= solved(PLAIN).values - TOLERANCE).all()


@pytest.mark.parametrize(
    "query",
    [
        Query("double-integrator-1d", Goal((0.0,), 0.5)),
        replace(PLAIN, input_lower=(-1.0, -1.0), input_upper=(1.0, 1.0)),
    ],
)
def test_other_queries_are_refused(query: Query) -> None:
    with pytest.raises(SolveError, match="no drift and no input bounds") as error:
        sweep_time_free(query, Grid.for_query(query, 1000))
    assert error.value.status is Status.NOT_APPLICABLE


def test_bad_grids_are_refused() -> None:
    with pytest.raises(ValueError, match="3 states"):
        sweep_time_free(PLAIN, Grid((0.0,), (1.0,), (5,), (False,)))
    with pytest.raises(ValueError, match="upper_bound"):
        sweep_time_free(PLAIN, SMALL, upper_bound=np.zeros(3))
    tiny = replace(PLAIN, goal=Goal((1.0, 1.0), 1e-6))
    with pytest.raises(ValueError, match="too coarse"):
        sweep_time_free(tiny, Grid.of(PLAIN.system, (4, 4, 4)))
