"""Value iteration for drift and bounded inputs, against closed forms and the time-free schemes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from ocp.cost import RunningCost
from ocp.grid import Grid, GridValue
from ocp.grids.lookahead import LookaheadPolicy
from ocp.grids.semi_lagrangian import sweep_time_free
from ocp.grids.value_iteration import iterate_values
from ocp.obstacle import Obstacle
from ocp.query import Goal, Query
from ocp.query_family import paper_query
from ocp.trajectory import Status
from sims.closed_loop import rollouts

STEEP = RunningCost(goal_steepness=500.0)  # W is 1 outside the goal, up to some millimetres


def solved(query: Query, grid: Grid) -> GridValue:
    return GridValue(grid, iterate_values(query, grid).checked().values)


@pytest.mark.parametrize("limit", [0.5, 4.0])
def test_a_bounded_point_robot(limit: float) -> None:
    """At speed u a metre costs (1 + u^2) / u, least at u = 1 or at the bound."""
    query = Query(
        "single-integrator-1d", Goal((0.0,), 0.5), (), STEEP, input_lower=(-limit,),
        input_upper=(limit,),
    )  # fmt: skip
    value = solved(query, Grid.of(query.system, (41,)))
    speed = min(limit, 1.0)
    metres = np.maximum(abs(value.grid.axes[0]) - 0.5, 0.0)
    np.testing.assert_allclose(value.values, metres * (1 + speed**2) / speed, atol=1e-3)


@pytest.mark.parametrize("upper", [(0.25, 1.0), (0.5, 0.25)])
def test_unequal_bounds(upper: tuple[float, float]) -> None:
    """Only the first axis matters far to the left of a goal that fills the box's height."""
    query = Query(
        "single-integrator-2d", Goal((4.0, 0.0), 0.9), (), STEEP,
        input_lower=(-1.0, -1.0), input_upper=upper,
    )  # fmt: skip
    found = float(solved(query, Grid.of(query.system, (41, 41))).value([-3.0, 0.0]))
    speed = min(upper[0], 1.0)
    assert -1e-6 < found / ((7.0 - 0.9) * (1 + speed**2) / speed) - 1 < 0.01


def double_integrator_value(distance: float, speed: float) -> float:
    """Least time plus integral of u^2 to move `distance` metres, from `speed` in that direction.

    The velocity at the end is free, so the costate of the velocity is c (T - t), c that of the
    position, and u = c (T - t) / 2. H = 0 at the end says that the final speed is 1 / c.
    """

    def duration(c: float) -> float:
        return float(np.sqrt(max(4 / c * (1 / c - speed), 0.0)))

    def missing(c: float) -> float:
        t = duration(c)
        return speed * t + c * t**3 / 6 - distance

    c = float(np.asarray(brentq(missing, 1e-4, 1 / speed if speed > 0 else 1e3)))
    return duration(c) + c**2 * duration(c) ** 3 / 12


DRIFTING = Query("double-integrator-1d", Goal((-2.0,), 0.5), (), STEEP)
DRIFTING_STATES = np.array([(2.0, 0.0), (0.0, -1.0), (1.0, 1.0), (3.0, -1.5)])
DRIFTING_OPTIMA = np.array([double_integrator_value(p + 1.5, -v) for p, v in DRIFTING_STATES])


def test_the_double_integrator_converges_to_its_closed_form() -> None:
    errors = []
    for count in (31, 61, 121):
        value = solved(DRIFTING, Grid.of(DRIFTING.system, (count, count)))
        errors.append(float(abs(value.value(DRIFTING_STATES) / DRIFTING_OPTIMA - 1).max()))
    assert errors[0] < 0.025
    assert errors[2] < 0.004
    assert errors[2] < errors[0] / 3  # first order would be a quarter


def test_the_double_integrators_closed_loop_is_near_optimal() -> None:
    value = solved(DRIFTING, Grid.of(DRIFTING.system, (61, 61)))
    results = rollouts(LookaheadPolicy(DRIFTING, value), list(DRIFTING_STATES))
    for result, optimum in zip(results, DRIFTING_OPTIMA, strict=True):
        assert result.cost is not None
        assert -0.003 < result.cost / optimum - 1 < 0.005  # the hit counts 1 mm early


def test_where_every_motion_leaves_the_box_the_value_is_infinite() -> None:
    value = solved(DRIFTING, Grid.of(DRIFTING.system, (31, 31)))
    assert np.isinf(value.value([4.9, 4.9]))  # no input sampled stops in 10 cm from 5 m/s
    assert np.isfinite(value.value([4.5, -1.0]))


def test_a_time_free_query_solved_in_both_ways() -> None:
    """The scheme for arc length, and the one for time with bounds too wide to matter."""
    query = paper_query((1.0, 1.0))
    wide = replace(query, input_lower=(-4.0, -4.0), input_upper=(4.0, 4.0))
    assert wide.is_bounded
    states = np.random.default_rng(0).uniform(-4.5, 4.5, (300, 3))
    states = states[query.goal_distance(states) > 0.5]
    shape = (17, 17, 12)
    in_time = solved(wide, Grid.of(query.system, shape)).value(states)
    free = solved(query, Grid.of(query.system, (17, 17, 6), half_turn=True)).value(states)
    fine = Grid.for_query(query, 60_000)
    reference = GridValue(fine, sweep_time_free(query, fine).values).value(states)
    assert abs(np.median(in_time / free) - 1) < 0.03
    for found in (in_time, free):
        assert 0.0 < np.median(found / reference - 1) < 0.15


def test_hard_obstacles_are_gone_around() -> None:
    bar = [(0.0, -5.5), (0.3, -5.5), (0.3, 2.0), (0.0, 2.0)]
    wall = Obstacle.polygon(bar, hard=True)
    query = Query(
        "single-integrator-2d", Goal((3.0, -2.0), 0.5), (wall,),
        RunningCost(goal_steepness=500.0, obstacle=0.0),
        input_lower=(-4.0, -4.0), input_upper=(4.0, 4.0),
    )  # fmt: skip
    value = solved(query, Grid.of(query.system, (41, 41)))
    start, corners = np.array([-3.0, -2.0]), np.array([[0.0, 2.0], [0.3, 2.0], [3.0, -2.0]])
    path = np.vstack([start, corners])
    shortest = np.linalg.norm(np.diff(path, axis=0), axis=1).sum() - 0.5
    assert 1.0 <= float(value.value(start)) / (2 * shortest) < 1.05


def test_an_unfinished_iteration_says_so() -> None:
    result = iterate_values(DRIFTING, Grid.of(DRIFTING.system, (31, 31)), max_sweeps=3)
    assert result.status is Status.NOT_CONVERGED


def test_an_upper_bound_is_kept() -> None:
    grid = Grid.of(DRIFTING.system, (31, 31))
    free = solved(DRIFTING, grid).values
    bounded = iterate_values(DRIFTING, grid, np.full(grid.shape, 3.0)).values
    np.testing.assert_allclose(bounded, np.minimum(free, 3.0), atol=0.05)
    assert bounded.max() <= 3.0


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="2 states"):
        iterate_values(DRIFTING, Grid((0.0,), (1.0,), (5,), (False,)))
    with pytest.raises(ValueError, match="upper_bound"):
        iterate_values(DRIFTING, Grid.of(DRIFTING.system, (31, 31)), np.zeros(3))
