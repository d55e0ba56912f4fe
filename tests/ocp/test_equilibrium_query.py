"""Queries whose goal is an equilibrium: what is refused, files, angles, costs of one's own."""

import shutil
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from ocp.compiled.batch import running_costs, state_costs
from ocp.cost import RunningCost, quadratic_cost
from ocp.models.robots import robot_file
from ocp.query import Equilibrium, Goal, ModelFile, Query

M = ((5.0, 0.3), (0.3, 0.5))
COST = RunningCost(goal=0.0, state=M)
UP = Equilibrium((np.pi, 0.0), 0.2)


@given(st.floats(-20, 20), st.floats(-5, 5))
def test_the_quadratic_cost_respects_angles(angle: float, rate: float) -> None:
    """Periodic, never negative, and near the goal the quadratic form itself."""
    period = np.array([2 * np.pi, 0.0])
    goal = np.array([np.pi, 0.0])

    def W(a: float, b: float) -> float:
        return float(quadratic_cost(ca.DM([a, b]), ca.DM(goal), ca.DM(np.array(M)), period))

    assert W(angle, rate) >= -1e-12
    assert W(angle + 2 * np.pi, rate) == pytest.approx(W(angle, rate), abs=1e-9)
    small = 1e-3 * np.array([np.sin(angle), rate / 5])
    form = small @ np.array(M) @ small
    assert W(*(goal + small)) == pytest.approx(form, rel=1e-4, abs=1e-13)


def test_holding_inputs_cost_nothing() -> None:
    query = Query(
        "planar_quadrotor",
        Equilibrium((1.0, 2.0, 0.0, 0.0, 0.0, 0.0), 0.1),
        cost=RunningCost(goal=0.0, state=tuple(map(tuple, np.eye(6).tolist()))),
    )
    assert_allclose(query.reference_input, 0.8 * 9.81 / 2, rtol=1e-12)
    assert running_costs(query, query.reference, query.reference_input) == pytest.approx(0.0)
    assert running_costs(query, query.reference, [0.0, 0.0]) == pytest.approx(2 * 3.924**2)


def test_distances_to_the_goal_go_the_short_way_round() -> None:
    query = Query("pendulum", UP, cost=COST)
    assert float(query.goal_distance([-np.pi + 0.3, 0.4])) == pytest.approx(0.5 - 0.2)


def test_actuators_limit_inputs_with_or_without_bounds_of_the_query() -> None:
    for lower, upper, expected in (
        (None, None, (-2.5, 2.5)),
        ((-1.0,), (9.0,), (-1.0, 2.5)),
    ):
        bounds = Query("pendulum", UP, cost=COST, input_lower=lower, input_upper=upper).input_bounds
        assert_allclose(np.ravel(bounds), expected)


def own_cost() -> ca.Function:
    x = ca.SX.sym("x", 2)  # pyright: ignore[reportArgumentType]
    return ca.Function("near_the_wall", [x], [3 * ca.sin((x[0] - np.pi) / 2) ** 4])


def test_ones_own_cost_is_added_compiled_and_travels() -> None:
    import pickle

    query = Query("pendulum", UP, cost=RunningCost(goal=0.0, state=M, own=own_cost()))
    states = np.random.default_rng(0).uniform(-3, 3, (5, 2))
    added = state_costs(query, states) - state_costs(Query("pendulum", UP, cost=COST), states)
    assert_allclose(added, 3 * np.sin((states[:, 0] - np.pi) / 2) ** 4, atol=1e-12)
    assert pickle.loads(pickle.dumps(query)) == query
    with pytest.raises(ValueError, match=r"cost.own: .* no file holds it"):
        query.dumps()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"goal": Equilibrium((1.0, 0.0), 0.1)}, None),
        ({"goal": Equilibrium((1.5, 0.0), 0.1)}, "takes pivot = 4.893 N m, .* not inside"),
        ({"goal": Equilibrium((np.pi, 1.0), 0.1)}, "cannot rest .* pivot_q moves at 1 rad/s"),
        ({"goal": Equilibrium((np.pi,), 0.1)}, "goal.state: pendulum needs 2 numbers"),
        ({"goal": Goal((np.pi,), 0.1)}, "pivot_q is an angle"),
        ({"cost": RunningCost(goal=0.0)}, "cost.state: missing"),
        ({"cost": RunningCost(state=M)}, "cost.goal: must be 0"),
        ({"cost": RunningCost(goal=0.0, state=M, own=ca.Function("f", [ca.SX.sym("x")], [1]))},
         "cost.own: must be an SX function of a 2 x 1 state"),
    ],
)  # fmt: skip
def test_what_is_no_goal_is_refused(change: dict, message: str | None) -> None:
    arguments = {"goal": UP, "cost": COST} | change
    if message is None:  # 1 rad takes 4.1 N m
        message = "not inside"
    with pytest.raises(ValueError, match=message):
        Query("pendulum", **arguments)


TEXT = """
model = "mine/robot.sdf"
[goal]
state = [3.141592653589793, 0]
radius = 0.2
[cost]
state = [5, 0.5]
"""


def test_a_query_file_may_name_a_robot_file_in_its_folder(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    shutil.copy(robot_file("pendulum"), tmp_path / "mine" / "robot.sdf")
    path = tmp_path / "query.toml"
    path.write_text(TEXT)
    query = Query.load(path)
    assert query.model == ModelFile("mine/robot.sdf", str(tmp_path))
    assert query.cost.state == ((5.0, 0.0), (0.0, 0.5))
    assert (query.system.n, query.system.m) == (2, 1)
    path.write_text(query.dumps())
    assert Query.load(path) == query


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ("../robot.sdf", "lies outside the query file's folder"),
        ("/robot.sdf", "lies outside the query file's folder"),
        ("none.sdf", "is not in the query file's folder"),
        ("robot.py", "is not registered"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, model: str, message: str) -> None:
    folder = tmp_path / "inner"
    folder.mkdir()
    shutil.copy(robot_file("pendulum"), tmp_path / "robot.sdf")
    path = folder / "query.toml"
    path.write_text(TEXT.replace("mine/robot.sdf", model))
    with pytest.raises(ValueError, match=message):
        Query.load(path)
