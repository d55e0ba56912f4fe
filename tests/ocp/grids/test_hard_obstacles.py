"""Hard obstacles as compiled solvers see them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ocp.grid import Grid, GridValue
from ocp.grids.bellman import bellman_geometry
from ocp.grids.hard_obstacles import (
    blocked_moves,
    clear_segment,
    clearance,
    hard_data,
    interpolate_joined,
    interpolate_visible,
)
from ocp.obstacle import Obstacle
from ocp.query import Goal, Query

SHAPES = (
    Obstacle.circle((-1.0, -1.0), 0.9, hard=True),
    Obstacle.diamond((2.0, -2.0), 0.8, hard=True),
    Obstacle.polygon([(-2.0, 1.0), (0.5, 1.2), (0.2, 2.5), (-1.5, 3.0)], hard=True),
    Obstacle.circle((3.0, 3.0), 0.5),  # soft: no business of these functions
)
QUERY = Query("unicycle", Goal((4.0, 4.0), 0.5), SHAPES, robot_radius=0.1)
BALLS = Query(
    "single-integrator-3d",
    Goal((4.0, 4.0, 4.0), 0.5),
    (Obstacle.circle((0.0, 0.0, 0.0), 1.0, hard=True),),
)
numbers = st.floats(-5, 5)


@pytest.mark.parametrize("query", [QUERY, BALLS])
def test_clearance_is_the_querys(query: Query) -> None:
    d = len(query.system.position)
    points = np.random.default_rng(0).uniform(-5, 5, (2000, d))
    states = np.zeros((len(points), query.system.n))
    states[:, :d] = points
    data = hard_data(query)
    found = [clearance(x, data) for x in states]
    np.testing.assert_allclose(found, query.clearance(states, hard_only=True), atol=1e-12)


@given(numbers, numbers, numbers, numbers)
def test_a_clear_segment_touches_nothing(ax: float, ay: float, bx: float, by: float) -> None:
    start, end = np.array([ax, ay, 0.0]), np.array([bx, by, 0.0])
    along = start + np.linspace(0, 1, 400)[:, None] * (end - start)
    least = QUERY.clearance(along, hard_only=True).min()
    if clear_segment(start, end, hard_data(QUERY)):
        assert least > 0
    else:  # the samples miss the closest point by at most half their distance
        assert least < np.linalg.norm(end - start) / 800 + 1e-9


def test_without_hard_obstacles_everything_is_clear() -> None:
    soft = Query("unicycle", Goal((4.0, 4.0), 0.5), SHAPES[3:])
    data = hard_data(soft)
    assert clear_segment(np.array([3.0, 0.0, 0.0]), np.array([3.0, 5.0, 0.0]), data) == 1.0
    assert clearance(np.zeros(3), data) == np.inf


def test_margin_grows_the_robot() -> None:
    here = np.zeros(3)
    shrunk = clearance(here, hard_data(QUERY, margin=0.3))
    assert shrunk == pytest.approx(clearance(here, hard_data(QUERY)) - 0.3)


WALL = Obstacle.polygon([(0.01, -6.0), (0.02, -6.0), (0.02, 6.0), (0.01, 6.0)], hard=True)
WALLED = Query("single-integrator-2d", Goal((3.0, 0.0), 0.5), (WALL,))
GRID = Grid.of(WALLED.system, (21, 21))


def test_a_wall_thinner_than_a_cell_blocks_exactly_the_moves_across_it() -> None:
    moves = np.array([(1, 0), (-1, 0), (0, 1), (1, 1), (2, -1)])
    blocked = blocked_moves(WALLED, GRID, moves)
    x = GRID.axes[0]
    for bit, (dx, _) in enumerate(moves):
        crosses = (x < 0.01) != (x + dx * GRID.spacing[0] < 0.01)
        expected = np.broadcast_to(crosses[:, None], GRID.shape)
        np.testing.assert_array_equal(blocked >> bit & 1 == 1, expected)


def test_values_do_not_mix_through_a_wall() -> None:
    left = GRID.nodes()[..., 0] < 0.01
    values = np.where(left, 100.0, 1.0).ravel()
    geometry = bellman_geometry(WALLED, GRID)
    # The nodes are at 0 and 0.5; a metre costs 2.
    left_side = interpolate_visible(values, geometry, np.array([0.005, 0.3]))
    assert left_side == pytest.approx(100.0 + 2 * 0.005)
    right_side = interpolate_visible(values, geometry, np.array([0.03, 0.3]))
    assert right_side == pytest.approx(1.0 + 2 * 0.47)
    assert interpolate_visible(values, geometry, np.array([0.015, 0.3])) == np.inf
    assert interpolate_visible(values, geometry, np.array([5.1, 0.3])) == np.inf
    for x in (0.005, 0.03):
        assert interpolate_joined(values, geometry, np.array([x, 0.3])) == np.inf
    assert interpolate_joined(values, geometry, np.array([0.7, 0.3])) == pytest.approx(1.0)


def test_far_from_obstacles_interpolation_is_the_plain_one() -> None:
    rng = np.random.default_rng(1)
    grid = Grid.of(QUERY.system, (21, 21, 8))
    value = GridValue(grid, rng.random(grid.shape))
    states = rng.uniform((2.5, -1.0, -9.0), (5.0, 5.0, 9.0), (200, 3))
    geometry = bellman_geometry(QUERY, grid)
    for mixing in (interpolate_visible, interpolate_joined):
        found = [mixing(value.flat, geometry, x) for x in states]
        np.testing.assert_allclose(found, value.value(states), rtol=1e-12)


def test_beside_an_obstacle_infinite_nodes_do_not_count() -> None:
    grid = Grid.of(QUERY.system, (21, 21, 8))
    inside = QUERY.clearance(grid.nodes(), hard_only=True) < 0
    values = np.where(inside, np.inf, 7.0).ravel()
    geometry = bellman_geometry(QUERY, grid)
    for angle in np.linspace(0, 6, 20):
        beside = np.array([-1 + 1.01 * np.cos(angle), -1 + 1.01 * np.sin(angle), 0.3])
        found = interpolate_visible(values, geometry, beside)
        assert 7.0 <= found < 7.0 + 2 * grid.spacing[0]


def test_more_moves_than_a_mask_holds_are_refused() -> None:
    with pytest.raises(ValueError, match="at most 62"):
        blocked_moves(WALLED, GRID, np.zeros((63, 2), dtype=np.int64))
