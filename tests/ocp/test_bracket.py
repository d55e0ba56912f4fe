"""Certified lower bounds: below every motion's cost, at every point, for whatever grid."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from references import TABLE_ONE_OPTIMA, aligned_value, typical_query

from ocp.bracket import LowerBound, lower_bound
from ocp.compiled.batch import rates, running_costs, state_costs
from ocp.eikonal import solve_eikonal
from ocp.grids.goal_bound import HeadingGoalBound, RadialGoalBound, goal_bound
from ocp.grids.goal_table import goal_table
from ocp.interval import bounds
from ocp.pontryagin import exact_trajectory
from ocp.query import Query
from ocp.query_family import PAPER_START, paper_query, sample_start
from ocp.trajectory import SolveError, Status


@pytest.fixture(scope="module", params=[(4.0, 4.0), (1.0, 4.0)], ids=str)
def certified(request: pytest.FixtureRequest) -> LowerBound:
    return lower_bound(paper_query(request.param), nodes=20_000, factor=3)


def test_the_optimum_lies_in_the_bracket(certified: LowerBound) -> None:
    """And the bound is worth something: it is not far below."""
    exact = exact_trajectory(certified.query, PAPER_START).cost
    assert any(exact == pytest.approx(known, rel=1e-5) for known in TABLE_ONE_OPTIMA.values())
    bracket = certified.bracket(PAPER_START, exact)
    assert bracket.lower <= exact
    assert 0 < bracket.gap < 0.08


def test_no_motion_costs_less(certified: LowerBound) -> None:
    """Exact motions from random starts, and each of their points on the way."""
    rng = np.random.default_rng(2)
    for _ in range(6):
        motion = exact_trajectory(certified.query, sample_start(certified.query, rng))
        states = certified.query.system.wrap(motion.states)
        below = certified.value(states)
        assert (below <= motion.cost_to_go + 1e-6 * motion.cost).all()


def test_along_any_short_motion_it_falls_by_no_more_than_the_cost(certified: LowerBound) -> None:
    """The condition itself, L + grad w . f >= 0, at random states and inputs, between the nodes."""
    query, rng = certified.query, np.random.default_rng(3)
    system = query.system
    states = rng.uniform(system.lower, system.upper, (20_000, 3))
    states = states[query.goal_distance(states) > 0.01]
    angles = rng.uniform(-np.pi, np.pi, len(states))
    size = np.sqrt(state_costs(query, states))[:, None]  # the speed at which the bound is tightest
    inputs = size * np.column_stack([np.cos(angles), np.sin(angles)])
    step = 1e-4
    following = states + step * rates(query, states, inputs)
    half = states + step / 2 * rates(query, states, inputs)
    cost = step * running_costs(query, half, inputs)
    here, there = certified.value(states), certified.value(following)
    # The midpoint rule errs by a share of some step^2 of the cost; rounding by 1e-13.
    assert (here - there <= cost * (1 + 1e-3) + 1e-12).all()


def test_a_finer_grid_brings_a_better_bound() -> None:
    """On average over states, some of which obstacles do not concern."""
    query, rng = paper_query((1.0, 1.0)), np.random.default_rng(7)
    states = np.array([sample_start(query, rng) for _ in range(200)])
    coarse = lower_bound(query, nodes=8_000, factor=2).value(states)
    bound = lower_bound(query, nodes=60_000, factor=3)
    fine = bound.value(states)
    assert coarse.mean() < fine.mean()
    assert 0.9 * TABLE_ONE_OPTIMA[1.0, 1.0] < bound.value(PAPER_START) <= TABLE_ONE_OPTIMA[1.0, 1.0]


def test_the_radial_bound_is_the_closed_form_from_below() -> None:
    bound = RadialGoalBound(paper_query((4.0, 4.0)), 1.0)
    for distance in (0.01, 0.3, 2.0, 9.0):
        exact = aligned_value(0.5 + distance)
        assert exact * (1 - 0.01) < float(bound.at(np.array([distance]))[0]) <= exact


def test_the_bound_that_knows_headings_is_below_the_table_and_near_it() -> None:
    """The table is exact to 1e-5; phi's first level and the cells' ratios cost some
    0.5 % far from the goal, and a hundredth of cost near it."""
    query = paper_query((4.0, 3.0))
    bound = goal_bound(query, 1.0, 18.0)
    assert isinstance(bound, HeadingGoalBound)
    rng = np.random.default_rng(5)
    states = np.array([sample_start(query, rng) for _ in range(500)])
    near = np.array([[*(query.reference[:2] + 0.6 * np.array([c, s])), h] for c, s, h in
                     [(1.0, 0.0, 1.5), (0.0, 1.0, 0.1), (0.6, -0.8, 2.0)]])  # fmt: skip
    for rows in (states, near):
        exact = goal_table(query, 18.0).value(rows)
        assert (bound.value(rows) <= exact * (1 + 1e-5)).all()
        assert (bound.value(rows) >= 0.97 * exact - 0.02).all()


def test_no_point_of_a_cell_is_below_its_floor() -> None:
    query = paper_query((4.0, 3.0))
    x, y, headings = np.linspace(2, 6, 41), np.linspace(-1, 5, 41), np.linspace(-np.pi, 0, 20)
    rng = np.random.default_rng(6)
    i, j, k = rng.integers(0, 40, 9000), rng.integers(0, 40, 9000), rng.integers(0, 19, 9000)
    points = np.column_stack(
        [rng.uniform(axis[n], axis[n + 1]) for axis, n in ((x, i), (y, j), (headings, k))]
    )
    for bound in (goal_bound(query, 1.0, 12.0), RadialGoalBound(query, 1.0)):
        floors = bound.floors(x, y, headings)
        values = bound.value(points)
        assert (floors[i, j, k] <= values + 1e-12).all()
        assert np.median(values - floors[i, j, k]) < 0.5


def test_in_the_goal_and_outside_the_grid(certified: LowerBound) -> None:
    query = certified.query
    inside = np.array([*query.reference[:2], 0.3])
    assert float(certified.value(inside)) == 0.0
    outside = np.array([40.0, 0.0, 0.0])
    expected = RadialGoalBound(query, 1.0).at(np.array([float(query.goal_distance(outside))]))[0]
    assert float(certified.value(outside)) == pytest.approx(expected, rel=1e-5)


def test_the_way_outside_costs_the_way_to_the_edge_and_on(certified: LowerBound) -> None:
    """Never more than straight to a point of the edge at cost 2 a metre, and R from there."""
    query, grid = certified.query, certified.potential.grid
    positions = np.random.default_rng(4).uniform(-5, 5, (50, 2))
    leaving = certified._leaving(positions)
    for side in (grid.lower[0], grid.upper[0]):
        for y in np.linspace(-5, 5, 11):
            edge = np.array([side, y])
            onward = aligned_value(float(np.linalg.norm(edge - query.reference[:2])))
            assert (leaving <= 2 * np.linalg.norm(positions - edge, axis=1) + onward).all()
    assert (leaving >= certified._radial(query.goal_distance(_with_heading(positions))) - 0.2).all()


def _with_heading(positions: np.ndarray) -> np.ndarray:
    return np.column_stack([positions, np.zeros(len(positions))])


@pytest.mark.parametrize(
    "query",
    [
        typical_query("double-integrator-2d"),
        typical_query("single-integrator-2d"),
        replace(paper_query((4.0, 4.0)), input_upper=(1.0, 1.0)),
    ],
    ids=["drift", "two states", "bounded"],
)
def test_other_queries_are_refused(query: Query) -> None:
    with pytest.raises(SolveError) as caught:
        lower_bound(query, nodes=1000)
    assert caught.value.status is Status.NOT_APPLICABLE


# Interval arithmetic


@given(
    ends=st.lists(st.tuples(st.floats(-4, 4), st.floats(0, 3)), min_size=2, max_size=2),
    fractions=st.lists(st.floats(0, 1), min_size=2, max_size=2),
)
def test_no_point_of_a_box_is_outside_the_bounds(ends: list, fractions: list) -> None:
    x = ca.SX.sym("x", 2)  # pyright: ignore[reportArgumentType]
    a, b = x[0], x[1]
    expressions = ca.vertcat(
        a * b - a, a**2 + ca.exp(b / 3), ca.sin(2 * a) * ca.cos(b), ca.fabs(a) / (1 + b**2),
        ca.tanh(a - b), ca.fmax(a, b) * ca.fmin(a, 1.5), ca.sqrt(a**2 + b**2), ca.sign(a) * b,
        ca.if_else(a < b, a, 2 * b),
    )  # fmt: skip
    function = ca.Function("f", [x], [ca.densify(expressions)])
    boxes = [(np.array(low), np.array(low + width)) for low, width in ends]
    point = [low + t * width for (low, width), t in zip(ends, fractions, strict=True)]
    values = np.array(function(point)).ravel()
    for value, (low, high) in zip(values, bounds(function, boxes), strict=True):
        assert low - 1e-9 <= value <= high + 1e-9


def test_a_box_that_is_a_point_has_sharp_bounds() -> None:
    query = paper_query((1.0, 4.0))
    state = query.system.state
    function = ca.Function("W", [state], [ca.densify(query.state_cost_expression(state))])
    points = np.random.default_rng(0).uniform(-5, 5, (50, 3))
    ((low, high),) = bounds(function, [(c, c) for c in points.T])
    assert low == pytest.approx(state_costs(query, points), rel=1e-12)
    assert high == pytest.approx(low, rel=1e-12)


def test_the_value_itself_is_no_certified_bound() -> None:
    """What the correction is for: the grid's own value lies above V at some states."""
    query = paper_query((1.0, 4.0))
    value = solve_eikonal(query, nodes=20_000).value
    rng = np.random.default_rng(2)
    starts = [sample_start(query, rng) for _ in range(12)]
    above = [float(value.value(s)) > exact_trajectory(query, s).cost for s in starts]
    assert any(above)
