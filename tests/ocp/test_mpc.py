"""Model predictive control: each step is a true optimum, and what the cost at the end is worth."""

from dataclasses import replace

import numpy as np
import pytest
from references import ALL_QUERIES, TABLE_ONE_OPTIMA, typical_query
from scipy.optimize import minimize

from ocp.compiled.batch import rates, running_costs, state_costs
from ocp.eikonal import solve_eikonal
from ocp.grids.spline import SplineValue
from ocp.mpc import HorizonSettings, QuadraticEnd, ValueEnd, receding_horizon
from ocp.obstacle import Obstacle
from ocp.query_family import PAPER_GOALS, PAPER_START, paper_query
from ocp.riccati import LinearQuadratic, differential_riccati
from ocp.transcription.horizon import SMOOTHING
from sims.closed_loop import LoopSettings, rollout

EVERY_STEP = LoopSettings(period=0.1)


def advanced(query, state: np.ndarray, u: np.ndarray, step: float) -> tuple[np.ndarray, float]:
    """One Runge-Kutta step of the compiled kernels, which know nothing of the program."""
    slopes, costs = [], []
    for share in (0.0, 0.5, 0.5, 1.0):
        at = state + share * step * slopes[-1] if slopes else state
        slopes.append(rates(query, at, u))
        costs.append(float(running_costs(query, at, u)) - smoothed_away(query, at))
    weights = np.array([1, 2, 2, 1]) * step / 6
    return state + weights @ np.array(slopes), float(weights @ np.array(costs))


def smoothed_away(query, state: np.ndarray) -> float:
    """Q - Q^3 / (Q^2 + delta^2): by how much the program's goal cost is lower."""
    goal = float(state_costs(replace(query, obstacles=()), state))
    return goal - goal**3 / (goal**2 + SMOOTHING**2)


def horizon_cost(query, end, start: np.ndarray, inputs: np.ndarray, step: float) -> float:
    state, total = start, 0.0
    for u in inputs:
        state, run = advanced(query, state, u, step)
        total += run
    return total + end.derivatives(state)[0]


@pytest.mark.parametrize(
    ("goal", "start"), [((4.0, 4.0), (3.0, 3.2, 0.2)), ((1.0, 1.0), (-2.0, -1.2, 0.5))]
)
def test_a_step_is_what_a_general_minimiser_finds(goal, start) -> None:
    """BFGS on the inputs alone, with its own forward simulation, from another guess."""
    query, settings = paper_query(goal), HorizonSettings(steps=6, step=0.2)
    end = QuadraticEnd.towards_goal(query, 0.3)
    motion = receding_horizon(query, end, settings).value.motion(np.array(start))

    def cost(z: np.ndarray) -> float:
        return horizon_cost(query, end, np.array(start), z.reshape(-1, 2), settings.step)

    assert motion.cost == pytest.approx(cost(motion.inputs.ravel()), rel=1e-9)
    rng = np.random.default_rng(0)
    reference = minimize(cost, motion.inputs.ravel() + 0.1 * rng.normal(size=12), tol=1e-9)
    assert motion.cost == pytest.approx(reference.fun, rel=1e-7)
    np.testing.assert_allclose(motion.inputs.ravel(), reference.x, atol=2e-3)


@pytest.mark.parametrize(("model", "bounded"), ALL_QUERIES)
def test_the_motion_obeys_the_robot_and_its_limits(model: str, bounded: bool) -> None:
    query = typical_query(model, bounded)
    rng = np.random.default_rng(1)
    middle, half = (query.system.lower + query.system.upper) / 2, query.system.upper * 0.3
    start = query.check_start(middle + half * rng.uniform(-1, 1, query.system.n))
    settings = HorizonSettings(steps=8)
    motion = receding_horizon(query, settings=settings).value.motion(start)
    low, high = query.input_bounds
    assert (motion.inputs >= low).all()
    assert (motion.inputs <= high).all()
    state = start
    for u, reached in zip(motion.inputs, motion.states[1:], strict=True):
        state, _ = advanced(query, state, u, settings.step)
        np.testing.assert_allclose(reached, state, atol=1e-6)


def test_with_a_linear_robot_and_quadratic_costs_it_is_the_riccati_feedback() -> None:
    """V of the remaining problem at the end makes the horizon's value V itself, up to held inputs.

    The error of holding each input over a step h is of second order in h.
    """
    typical = typical_query("double-integrator-2d")
    query = replace(typical, obstacles=(), cost=replace(typical.cost, goal=0.0))
    horizon, P = 1.0, np.diag([0.5, 0.5, 0.2, 0.2])
    start = np.array([3.0, -2.0, 0.4, 0.3])
    exact = float(differential_riccati(LinearQuadratic.of_query(query), P, horizon).value(start))
    errors = []
    for steps in (5, 10, 20):
        settings = HorizonSettings(steps=steps, step=horizon / steps)
        motion = receding_horizon(query, QuadraticEnd(P, query.reference), settings)
        errors.append(float(motion.value.value(start)) / exact - 1)
    assert all(e > 0 for e in errors)
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 2.0, atol=0.2)


@pytest.mark.parametrize("goal", PAPER_GOALS)
def test_a_grid_value_at_the_end_makes_the_loop_nearly_optimal(goal) -> None:
    query = paper_query(goal)
    value = SplineValue(solve_eikonal(query).value.on_grid)
    loop = rollout(receding_horizon(query, ValueEnd.of(query, value)), PAPER_START, EVERY_STEP)
    assert loop.cost is not None
    # No loop beats the optimum by more than the goal's tolerance of 1 mm is worth.
    assert -1e-4 < loop.cost / TABLE_ONE_OPTIMA[goal] - 1 < 2e-3


def test_a_quadratic_end_costs_more_and_is_no_worse_than_the_papers() -> None:
    query = paper_query((4.0, 4.0))
    loop = rollout(receding_horizon(query), PAPER_START, EVERY_STEP)
    assert loop.cost is not None
    assert 1.02 * TABLE_ONE_OPTIMA[4.0, 4.0] < loop.cost < 28.2


def test_the_value_is_that_of_the_horizon_and_its_gradient_belongs_to_it() -> None:
    query = paper_query((1.0, 1.0))
    value = receding_horizon(query).value
    start = np.array([-3.0, 0.5, 0.3])
    slope, h = value.gradient(start), 1e-4
    for i in range(3):
        shift = h * np.eye(3)[i]
        difference = (value.value(start + shift) - value.value(start - shift)) / (2 * h)
        assert slope[i] == pytest.approx(difference, abs=1e-5)
    np.testing.assert_array_equal(value.gradient([1.0, 1.2, 0.0]), np.zeros(3))
    assert value.value([1.0, 1.2, 0.0]) == 0


def test_a_start_across_from_the_goal_is_no_trap() -> None:
    """Pointing exactly across, standing still is stationary for the cost, yet no minimum."""
    query = paper_query((4.0, 4.0))
    motion = receding_horizon(query).value.motion(np.array(PAPER_START))
    assert np.abs(motion.inputs).max() > 0.1


def test_hard_obstacles_are_not_entered() -> None:
    wall = Obstacle.circle((2.0, 0.3), 0.8, hard=True)
    query = replace(paper_query((4.0, 0.0)), obstacles=(wall,), robot_radius=0.2)
    loop = rollout(receding_horizon(query), (-1.0, 0.0, 0.0), EVERY_STEP)
    assert loop.reached
    # Clearance is asked for at the steps' ends: in between a path cuts the disc by its sagitta.
    speed = np.abs(loop.trajectory.inputs[:, 0]).max()
    assert loop.min_clearance > -((speed * EVERY_STEP.period) ** 2) / 8 / 1.0 - 1e-6


def test_a_policy_is_vectorised_and_rests_in_the_goal() -> None:
    query = paper_query((4.0, 4.0))
    policy = receding_horizon(query, settings=HorizonSettings(steps=5))
    states = np.array([[[0.0, 0.0, 0.3], [4.0, 4.2, 1.0]]])
    inputs = policy(states)
    assert inputs.shape == (1, 2, 2)
    np.testing.assert_allclose(inputs[0, 0], policy(states[0, 0]), atol=1e-7)
    np.testing.assert_array_equal(inputs[0, 1], [0.0, 0.0])
    with pytest.raises(ValueError, match="finite numbers"):
        policy([0.0, np.nan, 0.0])


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: HorizonSettings(steps=0),
        lambda: HorizonSettings(step=-0.1),
        lambda: HorizonSettings(max_iterations=0),
        lambda: QuadraticEnd.towards_goal(paper_query((4.0, 4.0)), 0.0),
    ],
)
def test_wrong_settings_are_refused(wrong) -> None:
    with pytest.raises(ValueError, match="must be"):
        wrong()
