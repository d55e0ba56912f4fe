"""The exact value without obstacles: closed forms, independent integration, its own equation."""

import logging
import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from references import TABLE_ONE_OPTIMA, aligned_value
from scipy.integrate import solve_ivp

from ocp.compiled.batch import minimised_hamiltonians
from ocp.cost import RunningCost
from ocp.grids import goal_table as module
from ocp.grids.goal_fan import Drive
from ocp.grids.goal_table import drive_of, goal_table, has_goal_table
from ocp.kernels import kernels, parameters
from ocp.models import get_model
from ocp.obstacle import Obstacle
from ocp.query import Goal, Query
from ocp.system import Coordinate, Input, System

PAPER = Query("unicycle", Goal((4.0, 4.0), 0.5))
HEAVY = Query("unicycle", Goal((1.0, -2.0), 0.35), (), RunningCost(input=(0.5, 2.0), goal=2.0))
STEEP = Query(
    "unicycle",
    Goal((-2.0, 0.0), 0.7),
    (),
    RunningCost(input=(3.0, 0.7), goal=0.5, goal_steepness=12.0),
)
CERTIFIED = 1e-3  # relative error that the table is good to everywhere


@pytest.fixture(scope="module", params=[PAPER, HEAVY, STEEP], ids=["paper", "weights", "steep"])
def query(request) -> Query:
    return request.param


def optimal_points(query: Query, final_headings, durations) -> tuple[np.ndarray, np.ndarray]:
    """States and costs on extremals, as long as they have not met their mirror image.

    Integrated by scipy, backward from the goal's boundary (at angle 0) with costate 0; an extremal
    meets its mirror image where the heading is tangential.
    """
    flow, q = kernels(query).flow, parameters(query)
    cost = kernels(query).state_cost
    x, y = query.goal_position

    def rate(_, y):
        out = np.empty(6)
        z = np.ascontiguousarray(y[:6])
        flow(z, q, out)
        return np.append(-out, 2.0 * cost(z[:3].copy(), q))

    def tangential(_, z):
        return math.cos(z[2] - math.atan2(z[1] - y, z[0] - x))

    tangential.terminal = True  # pyright: ignore[reportFunctionMemberAccess]
    found = []
    for heading in final_headings:
        start = [x + query.goal.radius * (1 + 1e-12), y, heading, 0, 0, 0, 0]
        path = solve_ivp(
            rate, (0, durations[-1]), start, method="DOP853", rtol=1e-11, atol=1e-13,
            t_eval=durations, events=tangential,
        )  # fmt: skip
        found.append(path.y.T)
    found = np.concatenate(found)
    distance = np.hypot(found[:, 0] - x, found[:, 1] - y) - query.goal.radius
    found = found[(distance > 1e-3) & (distance < 14.0)]
    return found[:, :3], found[:, 6]


def test_facing_the_goal_it_is_the_closed_form(query):
    table = goal_table(query, 14.0)
    w = query.cost
    r = query.goal.radius + np.array([0.003, 0.03, 0.2, 1.0, 3.0, 9.0])
    scale = math.sqrt(w.goal * query.input_weights[0])
    expected = scale * np.array([aligned_value(d, query.goal.radius, w.goal_steepness) for d in r])
    for ray in (0.0, 0.7, 2.9, -1.6):
        position = np.array(query.goal.center) + np.outer(r, [math.cos(ray), math.sin(ray)])
        for heading in (ray, ray + math.pi):
            states = np.column_stack([position, np.full(len(r), heading)])
            assert np.allclose(table.value(states), expected, rtol=1e-5)


def test_it_agrees_with_independent_integration_of_extremals(query):
    headings = (0.02, 0.3, 0.9, 1.3, 1.5, 1.56)
    states, costs = optimal_points(query, headings, np.linspace(0.3, 9.0, 30))
    assert len(costs) > 50
    error = abs(goal_table(query, 14.0).value(states) / costs - 1)
    assert error.max() < CERTIFIED
    assert np.median(error) < 1e-5


def test_it_is_the_optimum_found_by_collocation_and_shooting():
    start = [-4.0, -4.0, -math.pi / 4]
    assert float(goal_table(PAPER, 14.0).value(start)) == pytest.approx(
        TABLE_ONE_OPTIMA[4.0, 4.0], abs=3e-4
    )


def test_its_gradient_satisfies_the_hamilton_jacobi_equation(query):
    """min_u H(x, u, grad V) = 0, relative to W, away from the kink and the last millimetres."""
    table = goal_table(query, 14.0)
    rng = np.random.default_rng(3)
    ray, heading = rng.uniform(-np.pi, np.pi, (2, 400))
    r = query.goal.radius + 10 ** rng.uniform(-1.5, 0.9, 400)
    states = np.column_stack(
        [*np.array(query.goal.center)[:, None] + r * [np.cos(ray), np.sin(ray)], heading]
    )
    states = states[abs(np.cos(heading - ray)) > 0.02]
    residual = minimised_hamiltonians(query, states, table.gradient(states))
    zero = minimised_hamiltonians(query, states, np.zeros_like(states))  # W
    assert np.quantile(abs(residual / zero), 0.99) < 2e-2
    assert np.median(abs(residual / zero)) < 1e-3


def test_its_gradient_is_that_of_its_value():
    table = goal_table(HEAVY, 14.0)
    states = np.array([[0.0, 1.0, 0.3], [2.5, -2.0, 1.0], [1.0, -4.5, 3.0], [-3.0, -3.0, -2.0]])
    h = 1e-5
    for i in range(3):
        step = h * np.eye(3)[i]
        slope = (table.value(states + step) - table.value(states - step)) / (2 * h)
        assert np.allclose(table.gradient(states)[:, i], slope, atol=1e-7)


def test_beside_the_goal_and_tangential_it_grows_linearly():
    """V = 5.04 d at d -> 0 for the paper's cost, where facing the goal V falls like d^1.5."""
    table = goal_table(PAPER, 14.0)
    d = np.array([1e-3, 3e-3, 1e-2])
    tangential = table.value(np.column_stack([4.5 + d, 4.0 + 0 * d, np.full(3, np.pi / 2)]))
    assert np.allclose(tangential / d, 5.04, rtol=0.005)


positions = st.tuples(st.floats(-5, 5), st.floats(-5, 5))


@given(positions, st.floats(-6, 6), st.floats(-3, 3))
def test_it_has_the_robot_s_symmetries(position, heading, angle):
    """Rotation about the goal, reflection on a ray, half a turn."""
    table = goal_table(PAPER, 14.0)
    center = PAPER.goal_position
    offset = np.array(position) - center
    c, s = math.cos(angle), math.sin(angle)
    turned = center + np.array([[c, -s], [s, c]]) @ offset
    value = float(table.value([*position, heading]))
    assert value >= 0
    assert float(table.value([*turned, heading + angle])) == pytest.approx(
        value, rel=1e-9, abs=1e-9
    )
    assert float(table.value([*position, heading + np.pi])) == pytest.approx(value, rel=1e-9)
    mirrored = [*(center + offset * [1, -1]), -heading]
    assert float(table.value(mirrored)) == pytest.approx(value, rel=1e-9)


def test_in_the_goal_it_is_zero():
    table = goal_table(PAPER, 14.0)
    inside = [[4.0, 4.0, 0.3], [4.3, 4.3, 1.0]]
    assert (table.value(inside) == 0).all()
    assert (table.gradient(inside) == 0).all()


def test_on_a_product_of_coordinates_it_is_the_same():
    table = goal_table(PAPER, 14.0)
    x, y, headings = np.linspace(-5, 5, 7), np.linspace(-5, 5, 9), np.linspace(-3, 3, 11)
    nodes = np.stack(np.meshgrid(x, y, headings, indexing="ij"), axis=-1)
    assert np.allclose(table.on_product(x, y, headings), table.value(nodes), rtol=1e-12)


def test_a_radius_between_the_tabulated_ones_is_as_good():
    """Against extremals integrated for that very radius, over the range of the query families."""
    for radius in (0.3, 0.37, 0.61, 0.8):
        query = replace(PAPER, goal=Goal((0.0, 0.0), radius))
        states, costs = optimal_points(query, (0.5, 1.2, 1.45), np.linspace(0.3, 4.0, 8))
        error = abs(goal_table(query, 14.0).value(states) / costs - 1)
        assert error.max() < 2e-4
        assert np.median(error) < 1e-5


# Where it applies


def car(columns, coordinates=None) -> System:
    """A robot with states (x, y, heading) and these columns of G."""
    state = ca.SX.sym("x", 3)
    half = math.pi
    return System(
        "car",
        coordinates
        or (
            Coordinate("x", "m", -5.0, 5.0),
            Coordinate("y", "m", -5.0, 5.0),
            Coordinate("heading", "rad", -half, half, periodic=True),
        ),
        (Input("a", "1"), Input("b", "1")),
        state,
        ca.SX.zeros(3, 1),
        ca.horzcat(*[ca.vertcat(*column(state)) for column in columns]),
        (0, 1),
    )


def drive(speed):
    return lambda x: (speed * ca.cos(x[2]), speed * ca.sin(x[2]), ca.SX(0))


def turn(rate):
    return lambda _: (ca.SX(0), ca.SX(0), ca.SX(rate))


def test_a_scaled_unicycle_is_known_by_its_speeds():
    query = Query(
        car([turn(2.0), drive(2.0)]), Goal((0.0, 0.0), 0.5), cost=RunningCost(input=(4.0, 1.0))
    )
    assert drive_of(query) == Drive(4.0, 1.0, 1.0, 3.0)


def test_robots_that_move_otherwise_have_none():
    goal = Goal((0.0, 0.0), 0.5)

    def ahead(x):  # a point in front of the axle
        return (-ca.sin(x[2]), ca.cos(x[2]), ca.SX(1))

    def crab(x):
        return (-ca.sin(x[2]), ca.cos(x[2]), ca.SX(0))

    def varying(x):
        return (ca.cos(x[2]) * (1 + x[0] ** 2), ca.sin(x[2]) * (1 + x[0] ** 2), ca.SX(0))

    for columns in ([drive(1.0), ahead], [drive(1.0), crab], [varying, turn(1.0)]):
        assert drive_of(Query(car(columns), goal)) is None
    for model in ("single-integrator-2d", "single-integrator-3d", "double-integrator-2d"):
        d = len(get_model(model).position)
        assert drive_of(Query(model, Goal((0.0,) * d, 0.5))) is None
    assert drive_of(replace(PAPER, cost=RunningCost(goal=0.0))) is None
    assert drive_of(replace(PAPER, input_lower=(-1.0, -1.0))) is None


def test_obstacles_do_not_change_it():
    blocked = replace(PAPER, obstacles=(Obstacle.circle((0.0, 0.0), 1.0),))
    x = [-3.0, -3.0, 1.0]
    assert goal_table(blocked, 14.0).value(x) == goal_table(PAPER, 14.0).value(x)


def test_what_it_cannot_span_is_refused():
    nimble = replace(PAPER, cost=RunningCost(input=(9.0, 0.04)))  # turns at no cost
    assert not has_goal_table(nimble, 14.0)
    with pytest.raises(module.SolveError, match="no goal table"):
        goal_table(nimble, 14.0)
    with pytest.raises(ValueError, match="within 16 m"):
        goal_table(PAPER, 14.0).value([21.0, 4.0, 0.0])
    with pytest.raises(ValueError, match="finite"):
        goal_table(PAPER, 14.0).value([np.nan, 4.0, 0.0])


# On disk


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty cache folder, nothing in memory, and less to compute."""
    monkeypatch.setattr(module, "RADII", 3)
    monkeypatch.setattr(module, "cache_folder", lambda: tmp_path)
    module._stack.cache_clear()
    module._at_radius.cache_clear()
    yield tmp_path
    module._stack.cache_clear()
    module._at_radius.cache_clear()


def test_it_is_read_back_from_disk_bit_by_bit(folder, monkeypatch):
    first = goal_table(PAPER, 14.0)
    assert len(list(folder.rglob("*.npz"))) == 1
    module._stack.cache_clear()
    module._at_radius.cache_clear()
    monkeypatch.setattr(module, "tabulate", None)  # cannot be computed again
    assert np.array_equal(goal_table(PAPER, 14.0).table, first.table)


@pytest.mark.parametrize("damage", ["truncated", "altered", "pickled", "text"])
def test_a_damaged_file_is_refused_and_written_anew(folder, damage, caplog):
    first = goal_table(PAPER, 14.0)
    (path,) = folder.rglob("*.npz")
    with np.load(path) as file:
        contents = dict(file)
    if damage == "truncated":
        path.write_bytes(path.read_bytes()[:-1000])
    elif damage == "altered":
        contents["tables"][1, 20, 30] *= 1.0001
        np.savez(path, **contents)
    elif damage == "pickled":
        np.savez(path, tables=np.array([{}], dtype=object), digest=contents["digest"])
    else:
        path.write_text("no table")
    module._stack.cache_clear()
    module._at_radius.cache_clear()
    with caplog.at_level(logging.WARNING):
        again = goal_table(PAPER, 14.0)
    assert "computing it anew" in caplog.text
    assert np.array_equal(again.table, first.table)
    caplog.clear()
    module._stack.cache_clear()
    goal_table(PAPER, 14.0)
    assert not caplog.records
