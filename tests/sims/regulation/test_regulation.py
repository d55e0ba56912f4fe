"""Regulation in simulation: Drake, the compiled batch and theory say the same."""

from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov

from learning.q_learning.learned_regulator import solve_backward
from learning.q_learning.learner import LearnerSettings, QLearner
from ocp.riccati import algebraic_riccati, differential_riccati
from sims.regulation.simulation import (
    LinearPlant,
    drake_motion,
    drive_legs,
    probed_motions,
    regulated_costs,
    sampled_motion,
    streams,
)
from sims.regulation.study_events import held_cost
from sims.regulation.study_motions import load
from sims.regulation.study_times import exact_map
from sims.regulation.system_file import shipped_systems

NAMES = list(shipped_systems())
PERIOD = 0.01


def plant_of(system) -> LinearPlant:
    return LinearPlant(system.problem.A, system.problem.B)


@pytest.mark.parametrize(("name", "noise"), [("rover", 0.0), ("cart-pole", 1e-3)])
def test_the_batch_makes_the_motions_of_the_drake_diagram(name, noise):
    system = load(name, noise=noise)
    seconds, seeds = 0.6, [3, 4]
    states, inputs = probed_motions(
        plant_of(system),
        system.start,
        seconds,
        PERIOD,
        4,
        system.probing,
        system.behaviour_gain,
        noise,
        seeds,
    )
    for row, seed in enumerate(seeds):
        probing, sensor = streams(seed)
        settings = LearnerSettings(
            probing=system.probing, behaviour_gain=system.behaviour_gain, probe_throughout=True
        )
        learner = QLearner(system.cost, settings, probing)
        motion = drake_motion(
            plant_of(system), learner, system.start, seconds, PERIOD, noise, sensor
        )
        scale = np.abs(states[row]).max()
        assert motion.measured == pytest.approx(states[row], abs=1e-8 * scale)
        assert motion.inputs[:-1:4] == pytest.approx(inputs[row], abs=1e-6 * scale)
        assert motion.times == pytest.approx(PERIOD * np.arange(61))
        other = QLearner(system.cost, settings)
        other.absorb(states[row], inputs[row])
        assert learner.data.rows == other.data.rows == 15


def test_an_affine_plant_is_the_same_in_drake_and_by_matrix_exponentials():
    system = load("rover")
    plant = LinearPlant(system.problem.A, system.problem.B, np.array([0.0, 0.0, 1.0, -2.0]))

    def learner():
        return QLearner(system.cost, LearnerSettings(probing=10.0), np.random.default_rng(0))

    one = drake_motion(plant, learner(), system.start, 0.4, PERIOD)
    two = sampled_motion(plant, learner(), system.start, 0.4, PERIOD)
    assert one.states == pytest.approx(two.states, abs=1e-9)
    unforced = sampled_motion(plant_of(system), learner(), system.start, 0.4, PERIOD)
    assert np.abs(one.states - unforced.states).max() > 1e-2


@pytest.mark.parametrize("name", NAMES)
def test_control_drake_and_our_riccati_agree(name):
    """The horizon follows from the tolerance: deviations decay like exp(-2 rate t)."""
    import control
    from pydrake.systems.controllers import LinearQuadraticRegulator

    system = load(name)
    problem = system.problem
    algebraic = algebraic_riccati(problem)
    tolerance = 1e-8
    horizon = (np.log(1 / tolerance) + 8) / (2 * algebraic.decay_rate)
    differential = differential_riccati(problem, system.cost.terminal, horizon)
    K, P, _ = control.lqr(problem.A, problem.B, problem.M, problem.R)
    matrices: tuple[Any, ...] = (problem.A, problem.B, problem.M, problem.R)
    drake_K, drake_P = LinearQuadraticRegulator(*matrices)
    scale = np.abs(P).max()
    assert differential.P(0.0) == pytest.approx(P, abs=tolerance * scale)
    assert algebraic.P() == pytest.approx(P, abs=tolerance * scale)
    assert drake_P == pytest.approx(P, abs=tolerance * scale)
    assert differential.gain(0.0) == pytest.approx(K, abs=tolerance * np.abs(K).max() * 10)
    # And Q-learning's sweep, through the exact map.
    from learning.q_learning.quadratic_cost import QuadraticCost

    cost = QuadraticCost(problem.M, problem.R, system.cost.terminal, horizon)
    swept = solve_backward(cost, exact_map(problem.A, problem.B), affine=False)
    assert swept.P(0.0) == pytest.approx(P, abs=tolerance * scale)
    assert drake_K == pytest.approx(K, abs=tolerance * np.abs(K).max())


@pytest.mark.parametrize("name", NAMES)
def test_the_optimal_gain_costs_the_value_and_a_held_one_a_little_more(name):
    system = load(name)
    exact = system.exact()
    best = float(exact.value(system.start))
    costs, times, states = regulated_costs(
        plant_of(system), system.cost, exact.gain, [system.start, -2 * system.start]
    )
    assert costs == pytest.approx([best, 4 * best], rel=1e-8)
    assert times[-1] == pytest.approx(system.cost.horizon)
    assert states.shape == (2, len(times), system.problem.n)
    held, _, _ = regulated_costs(plant_of(system), system.cost, exact.gain, system.start, hold=0.05)
    assert best * (1 - 1e-9) <= held[0] <= best * (1 + 2e-3)
    other, _, _ = regulated_costs(
        plant_of(system), system.cost, lambda t: 1.05 * exact.gain(t), system.start
    )
    assert other[0] > best * (1 + 1e-7)


def test_the_cost_of_a_constant_gain_is_that_of_the_lyapunov_equation():
    system = load("springless-rover")
    problem = system.problem
    K = algebraic_riccati(problem).gain()
    closed = problem.A - problem.B @ K
    W = problem.M + K.T @ problem.R @ K
    S = solve_continuous_lyapunov(closed.T, -W)
    # The paper's P_T in place of S leaves x(T)'(S - P_T)x(T), which has decayed by T.
    costs, _, _ = regulated_costs(
        plant_of(system), system.cost, lambda t: np.broadcast_to(K, (len(t), 2, 4)), system.start
    )
    assert costs[0] == pytest.approx(system.start @ S @ system.start, rel=1e-4)


def test_an_offset_moves_the_rest():
    system = load("unstable")
    K, plant = algebraic_riccati(system.problem).gain(), plant_of(system)
    _, times, states = regulated_costs(
        plant,
        system.cost,
        lambda t: np.broadcast_to(K, (len(t), 1, 2)),
        system.start,
        offset=lambda t: np.full((len(t), 1), 0.7),
    )
    closed = plant.A - plant.B @ K
    rest = np.linalg.solve(closed, plant.B @ [0.7])
    expected = rest + expm(closed * times[-1]) @ (system.start - rest)
    assert states[0, -1] == pytest.approx(expected, abs=1e-9)
    assert np.abs(rest).min() > 0.1


def test_a_motion_that_blows_up_costs_infinity():
    system = load("cart-pole")
    costs, _, _ = regulated_costs(
        plant_of(system), system.cost, lambda t: np.full((len(t), 1, 4), 1e4), system.start
    )
    assert costs[0] == np.inf


def test_a_hold_that_does_not_fit_the_horizon_is_refused():
    system = load("rover")
    with pytest.raises(ValueError, match="hold: must divide the horizon"):
        regulated_costs(plant_of(system), system.cost, system.exact().gain, system.start, hold=0.03)


def test_the_cost_of_held_inputs_is_exact():
    """Against fine Runge-Kutta integration of one period's motion."""
    from scipy.integrate import solve_ivp

    system = load("unstable")
    A, B, cost = system.problem.A, system.problem.B, system.cost
    start, u = np.array([1.0, -0.4]), np.array([0.6])

    def rate(_, z):
        x = z[:2]
        return [*(A @ x + B @ u), x @ cost.M @ x + u @ cost.R @ u]

    end = solve_ivp(rate, (0, 0.3), [*start, 0.0], rtol=1e-11, atol=1e-13).y[:, -1]
    states = np.array([start, end[:2]])
    total = held_cost(LinearPlant(A, B), cost, states, np.array([u, u]), 0.3)
    assert total == pytest.approx(end[2] + end[:2] @ cost.terminal @ end[:2], rel=1e-9)


def test_legs_end_in_the_admissible_window_and_are_driven_in_error_coordinates():
    system = load("springless-rover")
    exact = system.exact()

    class Optimal:
        clock, legs = 0.0, 0

        def control(self, state):
            self.clock += PERIOD
            return exact.input(np.asarray(state), self.clock - PERIOD)

        def new_leg(self):
            self.clock = 0.0
            self.legs += 1

    waypoints = np.array([[0.0, 0, 0, 0], [3, 0, 0, 0], [3, 4, 0, 0]])
    controller = Optimal()
    course = drive_legs(plant_of(system), controller, waypoints, PERIOD, 10.0)
    assert course.reached == controller.legs == 2
    assert not course.blew_up
    # Each leg ends at 15 % of the error that it began with; the second began where the first ended.
    assert np.linalg.norm(course.states[-1] - waypoints[-1]) <= 0.15 * 5.0
    assert course.states[0] == pytest.approx(waypoints[0])
