"""One step of the discrete Bellman equation, and functions passed by address."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from references import aligned_value, typical_query

from ocp.compiled.batch import state_costs
from ocp.compiled.function_address import ADDRESSES, addresses, function_at
from ocp.compiled.jit import SCALAR, VECTOR, compiled, float64
from ocp.compiled.parameters import parameters
from ocp.cost import RunningCost
from ocp.grid import Grid, GridValue
from ocp.grids.bellman import (
    SCRATCH_ROWS,
    arrival_costs,
    bellman,
    bellman_addresses,
    bellman_geometry,
    bellman_settings,
    step_cost,
)
from ocp.grids.input_samples import sampled_inputs, unit_directions
from ocp.kernels import kernels
from ocp.obstacle import Obstacle
from ocp.query import Goal, Query

scalar_at = function_at(SCALAR)


@compiled(float64(ADDRESSES, VECTOR, VECTOR))
def _called(functions, x, q):
    return scalar_at(functions[0, 0], functions[0, 1])(x, q)


@pytest.mark.parametrize("model", ["unicycle", "rover"])
def test_a_function_by_address_is_the_function(model: str) -> None:
    query = typical_query(model)
    state_cost, q = kernels(query).state_cost, parameters(query)
    x = np.linspace(0.3, 1.0, query.system.n)
    assert _called(addresses([state_cost]), x, q) == state_cost(x, q) > 0


def one_step(query: Query, value: GridValue, x, u, cells: float = 1.0) -> float:
    x = np.asarray(x, dtype=float)
    return step_cost(
        x,
        np.asarray(u, dtype=float),
        float(state_costs(query, x)),
        bellman_addresses(query),
        parameters(query),
        bellman_settings(query, cells),
        value.flat,
        bellman_geometry(query, value.grid),
        np.empty((SCRATCH_ROWS, query.system.n)),
    )


PLANE = Query("single-integrator-2d", Goal((0.0, 0.0), 0.5))
GRID = Grid.of(PLANE.system, (21, 21))


def flat_value(grid: Grid, level: float = 0.0) -> GridValue:
    return GridValue(grid, np.full(grid.shape, level))


def test_a_step_costs_twice_its_length_far_from_the_goal_and_adds_the_value() -> None:
    """There W = 1, and 2 sqrt(W) a metre is the cost at the best speed."""
    cost = one_step(PLANE, flat_value(GRID, 3.0), (4.0, 4.0), (-1.0, 0.0))
    assert cost == pytest.approx(2 * GRID.spacing[0] + 3.0, rel=1e-9)
    longer = one_step(PLANE, flat_value(GRID, 3.0), (4.0, 4.0), (-0.6, -0.8), cells=2.0)
    assert longer == pytest.approx(2 * 2 * GRID.spacing[0] / 0.8 + 3.0, rel=1e-9)


def test_a_bounded_step_costs_time_and_effort() -> None:
    query = Query(
        "single-integrator-2d", PLANE.goal, input_lower=(-1.0, -1.0), input_upper=(1.0, 1.0)
    )
    cost = one_step(query, flat_value(GRID, 3.0), (4.0, 4.0), (-0.25, 0.0))
    assert cost == pytest.approx(GRID.spacing[0] / 0.25 * (1 + 0.25**2) + 3.0, rel=1e-9)


def test_a_step_that_leaves_the_box_is_infinite() -> None:
    assert one_step(PLANE, flat_value(GRID), (4.9, 0.0), (1.0, 0.0)) == np.inf


def test_a_step_ends_at_the_first_hit_of_the_goal() -> None:
    """A value that is infinite everywhere does not matter then."""
    nowhere = flat_value(GRID, np.inf)
    assert one_step(PLANE, nowhere, (0.8, 0.0), (-1.0, 0.0)) == pytest.approx(
        aligned_value(0.8), rel=0.02
    )
    assert one_step(PLANE, nowhere, (0.8, 0.0), (0.0, 1.0)) == np.inf


def test_a_step_across_a_hard_obstacle_is_infinite() -> None:
    wall = Obstacle.polygon([(2.2, -4), (2.21, -4), (2.21, 4), (2.2, 4)], hard=True)
    query = Query("single-integrator-2d", PLANE.goal, (wall,), RunningCost(obstacle=0.0))
    assert one_step(query, flat_value(GRID), (2.4, 0.0), (-1.0, 0.0)) == np.inf
    away = one_step(query, flat_value(GRID), (2.4, 0.0), (1.0, 0.0))
    assert away == pytest.approx(2 * GRID.spacing[0], rel=1e-3)


def test_a_motion_that_speeds_up_is_shortened() -> None:
    """From rest, a small input takes long to change the speed by a cell, and by then the position
    has changed by many: the step must end earlier."""
    query = Query("double-integrator-1d", Goal((-4.0,), 0.5))
    grid = Grid.of(query.system, (41, 41))
    x, u = np.array([0.0, 0.0]), 0.01
    position = GridValue(grid, 100.0 * np.abs(grid.nodes()[..., 0]))
    moved = one_step(query, position, x, (u,))
    duration = np.sqrt(2 * grid.spacing[0] / u)
    assert moved == pytest.approx(duration * (1 + u**2) + 100 * grid.spacing[0], rel=0.2)


@given(st.floats(0.55, 0.9), st.floats(0, 2 * np.pi))
def test_arrival_is_the_closed_form_on_straight_drives(distance: float, angle: float) -> None:
    query = Query("unicycle", Goal((1.0, 1.0), 0.5))
    grid = Grid.for_query(query, 9000)
    at = np.array([1 + distance * np.cos(angle), 1 + distance * np.sin(angle), angle])
    cost = arrival_costs(query, grid, at[None], 2.0)[0]
    assert cost == pytest.approx(aligned_value(distance), rel=0.02)


@given(st.floats(-4, 4), st.floats(-4, 4), st.floats(-3, 3))
def test_refinement_never_loses_to_the_samples(x: float, y: float, heading: float) -> None:
    query = Query("unicycle", Goal((1.0, 1.0), 0.5), (Obstacle.circle((-1, -1), 1),))
    grid = Grid.of(query.system, (21, 21, 12))
    value = GridValue(grid, np.random.default_rng(0).uniform(0, 5, grid.shape))
    state = np.array([x, y, heading])
    candidates, spread = sampled_inputs(query)
    best = np.full(2, np.nan)
    found = bellman(
        state, best, candidates, spread, 3, bellman_addresses(query), parameters(query),
        bellman_settings(query), value.flat, bellman_geometry(query, grid),
        np.empty((SCRATCH_ROWS, 3)),
    )  # fmt: skip
    assert found <= min(one_step(query, value, state, u) for u in candidates)
    assert found == pytest.approx(one_step(query, value, state, best), rel=1e-12)
    assert (query.input_weights * best**2).sum() == pytest.approx(1.0)


@pytest.mark.parametrize("m", [1, 2, 3])
def test_sampled_directions_are_unit_and_come_in_opposite_pairs(m: int) -> None:
    directions = unit_directions(m)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    gaps = np.linalg.norm(directions[:, None] + directions, axis=2).min(axis=1)
    np.testing.assert_allclose(gaps, 0.0, atol=1e-12)


@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("model", ["unicycle", "rover", "double-integrator-3d"])
def test_sampled_inputs_are_admissible(model: str, bounded: bool) -> None:
    query = typical_query(model, bounded)
    inputs, spread = sampled_inputs(query)
    lower, upper = query.input_bounds
    assert ((inputs >= lower) & (inputs <= upper)).all()
    assert (spread > 0).all()
    if query.is_time_free:
        np.testing.assert_allclose((query.input_weights * inputs**2).sum(axis=1), 1.0)
    elif bounded:
        assert (inputs == lower).all(axis=1).any()
        assert (inputs == upper).all(axis=1).any()
