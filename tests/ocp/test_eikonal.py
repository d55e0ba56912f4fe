"""The door to the grid solvers: laws over all schemes."""

from dataclasses import replace

import numpy as np
import pytest
from references import TABLE_ONE_OPTIMA

from ocp.cost import RunningCost
from ocp.eikonal import EikonalSolution, Scheme, default_scheme, solve_eikonal
from ocp.grid import Grid
from ocp.obstacle import Obstacle
from ocp.query import Goal, Query
from ocp.query_family import PAPER_START, paper_query
from ocp.trajectory import SolveError, Status

QUERY = paper_query((1.0, 4.0))
SMALL = Grid.for_query(QUERY, 3000)
ALL = pytest.mark.parametrize("scheme", Scheme)

_solutions: dict[Scheme, EikonalSolution] = {}


def small_solution(scheme: Scheme) -> EikonalSolution:
    if scheme not in _solutions:
        _solutions[scheme] = solve_eikonal(QUERY, SMALL, scheme=scheme)
    return _solutions[scheme]


@ALL
def test_a_solution_says_how_it_came_about(scheme: Scheme) -> None:
    solution = small_solution(scheme)
    assert solution.status is Status.SOLVED
    assert solution.scheme is scheme
    assert solution.grid is SMALL
    assert solution.seconds > 0
    assert solution.fixed_point.sweeps >= 1
    assert solution.fixed_point.updates >= np.isfinite(solution.value.on_grid.values).sum() / 2


@ALL
def test_schemes_agree_to_their_order(scheme: Scheme) -> None:
    """On this coarse grid all lie within some per cent of each other and of the optimum."""
    values = small_solution(scheme).value.on_grid.values
    others = small_solution(Scheme.SEMI_LAGRANGIAN).value.on_grid.values
    assert np.isfinite(values).all()
    assert abs(np.median(values[others > 1] / others[others > 1]) - 1) < 0.06
    optimum = TABLE_ONE_OPTIMA[1.0, 4.0]
    assert -0.03 < float(small_solution(scheme).value.value(PAPER_START)) / optimum - 1 < 0.12


@ALL
def test_the_value_is_zero_in_the_goal_and_positive_outside(scheme: Scheme) -> None:
    value = small_solution(scheme).value
    rng = np.random.default_rng(0)
    angle, share = rng.uniform(0, 2 * np.pi, 200), rng.uniform(0, 0.999, 200)
    heading = rng.uniform(-9, 9, 200)
    inside = np.column_stack(
        [1 + 0.5 * share * np.cos(angle), 4 + 0.5 * share * np.sin(angle), heading]
    )
    assert (value.value(inside) == 0).all()
    assert (value.gradient(inside) == 0).all()
    outside = inside - np.array([1.2, 1.2, 0.0])
    assert (value.value(outside) > 0).all()


@ALL
def test_reversing_the_robot_changes_nothing(scheme: Scheme) -> None:
    value = small_solution(scheme).value
    states = np.random.default_rng(1).uniform(-4.9, 4.9, (100, 3))
    turned = states + np.array([0.0, 0.0, np.pi])
    np.testing.assert_allclose(value.value(states), value.value(turned), rtol=1e-9)
    np.testing.assert_allclose(value.gradient(states), value.gradient(turned), atol=1e-8)


@ALL
def test_hard_obstacles_are_infinite_and_never_lower_the_value(scheme: Scheme) -> None:
    ball = Obstacle.circle((-1.0, 1.0), 1.2)
    soft = solve_eikonal(replace(QUERY, obstacles=(ball,)), SMALL, scheme=scheme)
    hard_query = replace(QUERY, obstacles=(replace(ball, hard=True),))
    hard = solve_eikonal(hard_query, SMALL, scheme=scheme)
    rise = hard.value.on_grid.values - soft.value.on_grid.values
    # Differences of second order, and the march's use of them beside an obstacle, are not monotone.
    allowed = 0.15 if scheme is Scheme.FAST_MARCHING else 5e-3
    assert (rise > -allowed).all()
    assert np.median(rise[np.isfinite(rise)]) > -1e-4
    states = np.random.default_rng(2).uniform(-4.9, 4.9, (500, 3))
    inside = hard_query.clearance(states, hard_only=True) < 0
    assert inside.any()
    np.testing.assert_array_equal(np.isinf(hard.value.value(states)), inside)


@ALL
def test_a_goal_behind_walls_is_infeasible_not_wrong(scheme: Scheme) -> None:
    walls = tuple(
        Obstacle.polygon(bar, hard=True)
        for bar in (
            [(0, 3), (0.05, 3), (0.05, 5.5), (0, 5.5)],
            [(1.95, 3), (2, 3), (2, 5.5), (1.95, 5.5)],
            [(0, 3), (2, 3), (2, 3.05), (0, 3.05)],
        )
    )
    query = replace(QUERY, obstacles=walls, cost=RunningCost(obstacle=0.0))
    value = solve_eikonal(query, SMALL, scheme=scheme).value
    assert value.value(PAPER_START) == np.inf
    assert np.isfinite(value.value([1.0, 3.3, 0.0]))


def test_the_default_scheme_fits_the_query() -> None:
    assert default_scheme(QUERY) is Scheme.FAST_MARCHING
    drifting = Query("double-integrator-1d", Goal((0.0,), 0.5))
    assert default_scheme(drifting) is Scheme.VALUE_ITERATION
    assert solve_eikonal(drifting, nodes=400).scheme is Scheme.VALUE_ITERATION
    bounded = replace(QUERY, input_lower=(-1.0, -1.0), input_upper=(1.0, 1.0))
    assert default_scheme(bounded) is Scheme.VALUE_ITERATION


@pytest.mark.parametrize("scheme", [Scheme.FAST_MARCHING, Scheme.SEMI_LAGRANGIAN])
def test_a_scheme_that_does_not_apply_is_refused(scheme: Scheme) -> None:
    drifting = Query("double-integrator-1d", Goal((0.0,), 0.5))
    with pytest.raises(SolveError) as error:
        solve_eikonal(drifting, nodes=400, scheme=scheme)
    assert error.value.status is Status.NOT_APPLICABLE


def test_bad_states_are_refused() -> None:
    value = small_solution(Scheme.SEMI_LAGRANGIAN).value
    for ask in (value.value, value.gradient):
        with pytest.raises(ValueError, match="finite"):
            ask([0.0, np.nan, 0.0])
        with pytest.raises(ValueError, match="3"):
            ask([0.0, 0.0])
