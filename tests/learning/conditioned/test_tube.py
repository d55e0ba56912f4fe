"""Tubes: the second-order model of V along extremals, and the feedback that it gives."""

import numpy as np
import pytest

from learning.conditioned.tube import HANDOVER, TubePolicy, Tubes, TubeValue
from ocp.eikonal import solve_eikonal
from ocp.extremals.extremal import find_extremal
from ocp.extremals.warm_start import rollouts as rough
from ocp.grids.goal_table import goal_table
from ocp.pontryagin import exact_trajectory
from ocp.query_family import paper_query
from sims.closed_loop import rollout

START = np.array([-3.0, -2.0, 0.4])
CURVED = np.array([-1.0, 1.0, 1.9])


def extremal_of(query, start):
    policy = solve_eikonal(query, nodes=9_000).policy()
    guess = rough(query, policy, start)[0]
    assert guess is not None
    found = find_extremal(query, start, guess)
    assert found.trajectory is not None
    return found


@pytest.fixture(scope="module")
def open_query():
    return paper_query((4.0, 4.0))


@pytest.fixture(scope="module")
def tubes(open_query):
    return Tubes.around(open_query, [extremal_of(open_query, START)])


def test_the_model_is_of_third_order(open_query):
    """Against the exact value without obstacles: halving the distance divides the error by 8."""
    table = goal_table(open_query, 16.0)
    tubes = Tubes.around(open_query, [extremal_of(open_query, CURVED)])
    rng = np.random.default_rng(0)
    picked = tubes.points[: len(tubes.points) // 2 : 3, :3]
    directions = rng.normal(size=picked.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    errors = []
    for h in (0.2, 0.1):
        x = picked + h * directions
        values, _, covered = tubes.model(x)
        assert covered.all()
        errors.append(np.median(np.abs(values - table.value(x))))
    # The nearest point of the tube is not the one that was left, so the order is approximate.
    assert 5 < errors[0] / errors[1] < 14


def test_the_closed_loop_costs_what_the_extremal_costs(open_query, tubes):
    table = goal_table(open_query, 16.0)
    policy = TubePolicy(tubes, solve_eikonal(open_query, nodes=9_000).policy())
    optimum = exact_trajectory(open_query, START).cost
    loop = rollout(policy, START)
    assert loop.cost is not None
    assert -1e-5 < loop.cost / optimum - 1 < 1e-3
    assert TubeValue(tubes, table).value(START) == pytest.approx(optimum, rel=1e-6)


def test_it_steers_back_after_a_push(open_query, tubes):
    """From beside the tube's axis the loop is optimal to second order of the model's error."""
    policy = TubePolicy(tubes, solve_eikonal(open_query, nodes=9_000).policy())
    pushed = START + np.array([0.1, -0.1, 0.1])
    loop = rollout(policy, pushed)
    assert loop.cost is not None
    assert loop.cost / exact_trajectory(open_query, pushed).cost - 1 < 2e-3


def test_beyond_the_tube_the_base_answers(open_query, tubes):
    table = goal_table(open_query, 16.0)
    value = TubeValue(tubes, table)
    far = np.array([[3.0, -3.0, 1.0], [-4.0, 4.0, 2.0]])
    assert not tubes.model(far)[2].any()
    np.testing.assert_array_equal(value.value(far), table.value(far))
    np.testing.assert_array_equal(value.gradient(far), table.gradient(far))
    close = np.array([4.0 - 0.5 - HANDOVER / 2, 4.0, 0.0])
    assert not tubes.model(close[None])[2].any()


def test_headings_a_turn_apart_are_the_same(tubes):
    point = tubes.points[20, :3]
    here, there = (
        tubes.model(point[None] + np.array([0.05, 0, turn]))[0] for turn in (0.0, 2 * np.pi)
    )
    np.testing.assert_allclose(here, there, rtol=1e-9)


def test_no_extremals_cover_nothing(open_query):
    assert not Tubes.around(open_query, []).model(START[None])[2].any()
