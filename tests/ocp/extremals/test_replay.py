"""Replays against an independent integrator, on every model."""

import numpy as np
import pytest
from references import ALL_QUERIES, tame_states, typical_query
from scipy.integrate import solve_ivp

from ocp.cost import RunningCost
from ocp.extremals.replay import PiecewiseInput, replay
from ocp.query import Goal, Query


def by_scipy(query: Query, inputs: PiecewiseInput, start: np.ndarray) -> np.ndarray:
    """[x, cost] at the end of all intervals."""
    lower, upper = query.input_bounds
    z = np.append(start, 0.0)
    for duration, coefficients in zip(inputs.durations, inputs.coefficients, strict=True):

        def rate(t, z, duration=duration, coefficients=coefficients):
            powers = (t / duration) ** np.arange(len(coefficients))
            u = np.clip(powers @ coefficients, lower, upper)
            moved = np.array(query.system.dynamics(z[:-1], u))[:, 0]
            return np.append(moved, float(query.running_cost(z[:-1], u)))

        z = solve_ivp(rate, (0, duration), z, rtol=1e-9, atol=1e-11, max_step=duration / 20).y[
            :, -1
        ]
    return z


@pytest.mark.parametrize(("model", "bounded"), ALL_QUERIES)
def test_replay_agrees_with_scipy(model, bounded):
    query = typical_query(model, bounded)
    rng = np.random.default_rng(0)
    inputs = PiecewiseInput(np.array([0.7, 0.4]), rng.normal(size=(2, 3, query.system.m)))
    start = tame_states(model, rng, 1, 2.0)[0]
    run = replay(query, inputs, start)
    assert run.accurate
    expected = by_scipy(query, inputs, start)
    assert run.states[-1, -1] == pytest.approx(expected[:-1], rel=1e-6, abs=1e-6)
    assert run.costs[:, -1].sum() == pytest.approx(expected[-1], rel=1e-6)


def test_replay_of_polynomials_is_exact():
    """x' = 1 + 2 s + 3 s^2 in the fraction s of 2 seconds: x gains 2 (s + s^2 + s^3)."""
    query = Query("single-integrator-1d", Goal((4.0,), 0.5), cost=RunningCost(goal=0.0))
    run = replay(
        query,
        PiecewiseInput(np.array([2.0]), np.array([[[1.0], [2.0], [3.0]]])),
        np.array([[-1.0]]),
    )
    s = np.linspace(0, 1, run.states.shape[1])
    assert run.states[0, :, 0] == pytest.approx(-1 + 2 * (s + s**2 + s**3), abs=1e-10)
    assert run.times[0] == pytest.approx(2 * s)
    # integral of (1 + 2 s + 3 s^2)^2 over 2 seconds
    assert run.costs[0, -1] == pytest.approx(2 * (1 + 2 + 10 / 3 + 3 + 9 / 5), rel=1e-10)


def test_intervals_start_where_told_or_where_the_last_one_ended():
    query = typical_query("unicycle")
    rng = np.random.default_rng(1)
    inputs = PiecewiseInput(np.array([0.3, 0.5, 0.2]), rng.normal(size=(3, 2, 2)))
    whole = replay(query, inputs, np.zeros(3))
    assert np.array_equal(whole.states[1:, 0], whole.states[:-1, -1])
    apart = replay(query, inputs, whole.states[:, 0])
    assert apart.states == pytest.approx(whole.states, abs=1e-12)
    assert np.diff(whole.times[:, 0]) == pytest.approx([0.3, 0.5])


def test_inputs_are_clipped_to_the_bounds():
    query = Query(
        "single-integrator-1d", Goal((4.0,), 0.5), input_lower=(-0.5,), input_upper=(0.25,)
    )
    steep = PiecewiseInput(np.array([1.0, 1.0]), np.array([[[9.0]], [[-9.0]]]))
    run = replay(query, steep, np.zeros(1))
    assert run.states[:, -1, 0] == pytest.approx([0.25, -0.25], abs=1e-12)


def test_a_kink_of_the_cost_is_integrated():
    """Into the goal ball, where Q has a kink at the boundary: compare with two smooth parts."""
    query = Query("single-integrator-1d", Goal((0.0,), 0.5))
    one = replay(query, PiecewiseInput(np.array([2.0]), np.array([[[-1.0]]])), np.array([1.3]), 1)
    halves = PiecewiseInput(np.array([0.8, 1.2]), np.array([[[-1.0]], [[-1.0]]]))
    two = replay(query, halves, np.array([1.3]), 1)
    assert one.accurate
    assert one.costs[0, -1] == pytest.approx(two.costs[:, -1].sum(), abs=1e-10)


def test_a_motion_that_blows_up_is_not_called_accurate():
    query = Query("rover", Goal((0.0, 0.0), 0.5))
    wild = PiecewiseInput(np.array([1.0]), np.full((1, 1, 2), 1e300))
    assert not replay(query, wild, np.zeros(4)).accurate
