"""Fast marching: exact distances, orders of convergence, symmetry."""

import math
from functools import cache

import casadi as ca
import numpy as np
import pytest
from marching_problems import half, steered
from references import TABLE_ONE_OPTIMA, aligned_value

from ocp.cost import RunningCost
from ocp.grid import Grid, GridValue
from ocp.grids.fast_marching import _Problem, march, relaxation
from ocp.grids.goal_table import goal_table
from ocp.grids.selling_stencil import selling_stencil
from ocp.obstacle import Obstacle
from ocp.query import Goal, Query
from ocp.system import Coordinate, Input, System

START = np.array([-4.0, -4.0, -math.pi / 4])
THREE = (
    Obstacle.circle((-1.0, -1.0), 1.0),
    Obstacle.diamond((-2.0, 2.0), 0.8),
    Obstacle.diamond((2.0, -2.0), 0.8),
)
UNIT = RunningCost(goal_steepness=1e6, obstacle=0.0)
"""W = 1 outside the goal: V is twice the distance, in the metric (G R^-1 G')^-1."""


def order_of(errors, spacings) -> np.ndarray:
    errors, spacings = np.array(errors), np.array(spacings)
    return np.log(errors[:-1] / errors[1:]) / np.log(spacings[:-1] / spacings[1:])


# Against exact distances


SQUEEZED = np.array([[1.0, 0.3, 0.0], [0.2, 0.35, 0.1], [0.0, 0.2, 0.6]])
"""Offsets of its metric reach several cells."""


def exact_distance(points: np.ndarray, matrix: np.ndarray, radius: float) -> np.ndarray:
    """Distance `[k]` of `points` `[k, d]` from a ball about 0 in the metric M = (B B')^-1.

    The nearest point y of the sphere satisfies (M + m I) y = M x; m by bisection.
    """
    sizes, axes = np.linalg.eigh(np.linalg.inv(matrix @ matrix.T))
    z = points @ axes
    low, high, y = np.zeros(len(z)), np.full(len(z), 1e3 * sizes.max()), z
    for _ in range(60):
        m = (low + high) / 2
        y = sizes * z / (sizes + m[:, None])
        outside = np.linalg.norm(y, axis=1) > radius
        low, high = np.where(outside, m, low), np.where(outside, high, m)
    return np.sqrt((sizes * (z - y) ** 2).sum(axis=1))


def distance_error(matrix, cells: int, order: int) -> float:
    """Mean error of V, with W = 1 and exact values given within 0.7 m of a ball of 1 m.

    The box is not a constraint on paths: they may bend out of it, so its border is left out.
    """
    B = np.asarray(matrix, dtype=float)
    d = len(B)
    query = Query(steered(B), Goal((0.0,) * d, 1.0))
    grid = Grid.of(query.system, (cells + 1,) * d)
    nodes = grid.nodes().reshape(-1, d)
    distance = query.goal_distance(nodes)
    exact = np.where(distance <= 0, 0.0, 2 * exact_distance(nodes, B, 1.0))
    problem = _Problem(query, grid, relaxation(grid))
    given = np.where(distance < 0.7, exact, np.inf).reshape(grid.shape)
    values = problem.stencil.padded(given, np.inf)
    right = np.full(len(values), 4.0)
    values, _ = problem.solve(values, right, right, np.zeros((0, 2)), order)
    values = problem.stencil.unpadded(values).ravel()
    tested = (distance > 0.7) & (abs(nodes) < 3.5).all(axis=1)
    return float(abs(values - exact)[tested].mean())


@pytest.mark.parametrize(
    ("matrix", "cells", "order", "band"),
    [
        (np.eye(2), (40, 80, 160), 1, (0.8, 1.1)),
        (np.eye(2), (40, 80, 160), 2, (1.7, 2.4)),
        (np.eye(3), (24, 48), 1, (0.8, 1.3)),
        (np.eye(3), (24, 48), 2, (1.6, 2.4)),
        (SQUEEZED[:2, :2], (40, 80, 160), 1, (0.8, 1.1)),
        (SQUEEZED[:2, :2], (40, 80, 160), 2, (1.7, 2.4)),
        (SQUEEZED, (28, 56), 1, (0.6, 1.1)),
        (SQUEEZED, (28, 56), 2, (1.5, 2.4)),
    ],
    ids=["2d", "2d-2", "3d", "3d-2", "squeezed", "squeezed-2", "squeezed-3d", "squeezed-3d-2"],
)
def test_order_of_convergence_to_the_exact_distance(matrix, cells, order, band):
    errors = [distance_error(matrix, c, order) for c in cells]
    orders = order_of(errors, 1 / np.array(cells))
    assert ((band[0] < orders) & (orders < band[1])).all(), (errors, orders)


def test_in_one_dimension_steady_cost_gives_the_distance_exactly():
    assert distance_error([[1.5]], 20, 1) < 1e-12


@pytest.mark.parametrize("d", [1, 2, 3])
def test_from_the_goal_ball_alone_the_nodes_next_to_it_drive_straight_in(d):
    """The default start, and the costs of the query: V = 2 (|x - c| - r)."""
    query = Query(f"single-integrator-{d}d", Goal((0.3, -0.2, 0.1)[:d], 1.0), cost=UNIT)
    grid = Grid.of(query.system, (41,) * d)
    nodes = grid.nodes()
    exact = np.maximum(0.0, 2 * query.goal_distance(nodes))
    error = abs(march(query, grid) - exact)
    plain = abs(march(query, grid, seed=False) - exact)
    assert error.max() < 0.15  # of up to 14
    assert error.mean() < 0.01 + 0.3 * plain.mean()


def test_round_a_wall_it_is_the_length_of_the_shortest_path():
    """A wall from below up to y = 2, thinner than a cell: the path bends at its end."""
    wall = Obstacle.polygon([(-0.01, -7), (0.01, -7), (0.01, 2), (-0.01, 2)], hard=True)
    query = Query("single-integrator-2d", Goal((3.0, -2.0), 1.0), (wall,), UNIT)
    errors = []
    for count in (41, 81, 161):
        grid = Grid.of(query.system, (count, count))
        nodes = grid.nodes()
        # Behind the wall, below the line from the goal's rim over the wall's end.
        hidden = (nodes[..., 0] < -0.3) & (nodes[..., 1] < 0.0)
        tip = np.array([0.0, 2.0])
        exact = 2 * np.linalg.norm(nodes - tip, axis=-1) + 2 * (np.hypot(3.0, 4.0) - 1.0)
        errors.append(float((march(query, grid)[hidden] / exact[hidden] - 1).mean()))
    # The corner is a point source, with an error of first order whatever the differences.
    assert 0 < errors[2] < 0.03
    assert ((order_of(errors, [4, 2, 1]) > 0.7) & (order_of(errors, [4, 2, 1]) < 1.3)).all()


# The unicycle


@cache
def optimum_error(goal, cells: int, headings: int) -> float:
    """Relative error at START, which is a node."""
    obstacles = {(1.0, 1.0): THREE[:1], (4.0, 4.0): ()}.get(goal, THREE)
    query = Query("unicycle", Goal(goal, 0.5), obstacles)
    grid = half(query, cells + 1, cells + 1, headings)
    return float(GridValue(grid, march(query, grid)).value(START)) / TABLE_ONE_OPTIMA[goal] - 1


@pytest.mark.parametrize("goal", TABLE_ONE_OPTIMA)
def test_the_optimal_costs_of_the_paper_s_queries(goal):
    """START is where two ways round are equally good in [1, 1]: the largest error of the four."""
    coarse, fine = optimum_error(goal, 30, 8), optimum_error(goal, 110, 36)
    assert abs(coarse) < 0.02
    assert abs(fine) < 0.004
    assert abs(fine) < 0.5 * abs(coarse) + 1e-5


def test_without_obstacles_the_table_is_met_whatever_the_grid():
    """The scheme's truncation error is taken from the table's value, so V is exact at the nodes."""
    query = Query("unicycle", Goal((2.0, -1.0), 0.4))
    for shape in ((20, 25, 7), (31, 31, 12)):
        for order in (1, 2):
            grid = half(query, *shape)
            exact = goal_table(query, 14.0).value(grid.nodes())
            assert np.allclose(march(query, grid, order=order), exact, rtol=1e-9, atol=1e-9)


def unseeded_errors(cells: int, relaxation: float | None = None) -> np.ndarray:
    """Relative errors at random states without use of the table, against the table."""
    query = Query("unicycle", Goal((1.0, 0.5), 0.8))
    grid = half(query, cells + 1, cells + 1, round(0.315 * cells))
    states = np.random.default_rng(5).uniform([-5, -5, -np.pi], [5, 5, np.pi], (1500, 3))
    states = states[query.goal_distance(states) > 1.0]
    value = GridValue(grid, march(query, grid, relaxation=relaxation, seed=False)).value(states)
    return value / goal_table(query, 14.0).value(states) - 1


def test_with_the_relaxation_tied_to_the_grid_it_converges_off_axis():
    """At random states and headings, from the goal ball alone: an aligned test cannot see this."""
    cells = (30, 60, 120)
    errors = [float(np.median(abs(unseeded_errors(c)))) for c in cells]
    assert errors[-1] < 0.02
    mean = math.log(errors[0] / errors[-1]) / math.log(4)
    assert 1.0 < mean < 1.6, errors


def test_a_fixed_relaxation_does_not_converge():
    """It lets the robot slip sideways: V stays too low, however fine the grid."""
    errors = [float(np.median(unseeded_errors(c, relaxation=0.7))) for c in (60, 120)]
    assert errors[1] < min(errors[0], -0.02), errors


def test_facing_the_goal_it_converges_to_the_closed_form():
    query = Query("unicycle", Goal((0.0, 0.0), 0.5))
    distances = np.array([1.5, 2.5, 3.5, 4.5])
    states = np.column_stack([distances, 0 * distances, 0 * distances])
    exact = np.array([aligned_value(d) for d in distances])
    errors = []
    for count, headings in ((41, 12), (81, 24), (161, 48)):
        grid = half(query, count, count, headings)
        value = GridValue(grid, march(query, grid, seed=False)).value(states)
        errors.append(float(abs(value / exact - 1).mean()))
    assert errors[-1] < 0.01
    orders = order_of(errors, [4, 2, 1])
    assert ((orders > 1.0) & (orders < 1.9)).all()


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("seed", [True, False])
def test_half_a_turn_of_headings_gives_the_same_as_the_whole(order, seed):
    query = Query("unicycle", Goal((1.0, 3.0), 0.5), THREE)
    settings = {"order": order, "seed": seed, "relaxation": 0.2}
    part = march(query, half(query, 31, 29, 9), **settings)
    whole = march(query, Grid.of(query.system, (31, 29, 18)), **settings)
    assert np.allclose(whole[..., :9], part, rtol=1e-9)
    assert np.allclose(whole[..., 9:], part, rtol=1e-9)


def test_a_robot_in_other_units_has_the_same_stencil():
    """The unicycle with its heading in degrees: nothing is known of robots but their G and R."""
    state = ca.SX.sym("x", 3)
    degree = math.pi / 180
    degrees = System(
        "degrees",
        (
            Coordinate("x", "m", -5.0, 5.0),
            Coordinate("y", "m", -5.0, 5.0),
            Coordinate("heading", "deg", -180.0, 180.0, periodic=True),
        ),
        (Input("v", "m/s"), Input("w", "deg/s")),
        state,
        ca.SX.zeros(3, 1),
        ca.vertcat(
            ca.horzcat(ca.cos(state[2] * degree), 0),
            ca.horzcat(ca.sin(state[2] * degree), 0),
            ca.horzcat(0, 1),
        ),
        (0, 1),
        half_turn=2,
    )
    goal = Goal((1.0, 3.0), 0.5)
    known = Query("unicycle", goal)
    other = Query(degrees, goal, cost=RunningCost(input=(1.0, degree**2)))
    mine = selling_stencil(other, half(other, 25, 25, 8), 0.2)
    expected = selling_stencil(known, half(known, 25, 25, 8), 0.2)
    for field in ("offsets", "near", "far", "reverse", "entry"):
        assert np.array_equal(getattr(mine, field), getattr(expected, field))
    assert np.allclose(mine.weights, expected.weights, rtol=1e-9)
