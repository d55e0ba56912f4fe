"""The benchmark that identifies: exact on clean data, better than Q-learning on noisy data."""

import numpy as np
import pytest
from plants_for_learning import held_motion, optimal_gains

from learning.q_learning.certificate import relative_gain_error
from learning.q_learning.identification import identify
from learning.q_learning.learner import LearnerSettings, QLearner
from learning.q_learning.quadratic_cost import QuadraticCost

A = np.array([[0.0, 1.0], [-1.0, -0.4]])
B = np.array([[0.0], [1.0]])
COST = QuadraticCost(10 * np.eye(2), 2 * np.eye(1), 0.5 * np.eye(2), 5.0)


def motion(seed: int, holds: int, noise: float, drift=None):
    rng = np.random.default_rng(seed)
    inputs = rng.normal(size=(holds, 1))
    states = held_motion(A, B, [1.0, 0.0], 0.01, 4, inputs, drift)
    return states + noise * rng.normal(size=states.shape), inputs


def test_clean_data_give_the_plant_and_its_gain():
    states, inputs = motion(0, 50, 0.0)
    plant = identify(states, inputs, 0.01)
    assert pytest.approx(A, abs=1e-9) == plant.A
    assert pytest.approx(B, abs=1e-9) == plant.B
    assert not plant.c.any()
    times = np.linspace(0, 5, 6)
    exact = optimal_gains(A, B, COST.M, COST.R, COST.terminal, 5.0, times)
    assert plant.riccati(COST).gain(times) == pytest.approx(exact, abs=1e-7)


def test_a_constant_term_is_identified():
    states, inputs = motion(0, 50, 0.0, drift=np.array([0.3, -1.0]))
    plant = identify(states, inputs, 0.01, affine=True)
    assert plant.c == pytest.approx([0.3, -1.0], abs=1e-8)
    assert pytest.approx(A, abs=1e-8) == plant.A


def test_with_noise_it_errs_less_than_q_learning_from_the_same_windows():
    times = np.linspace(0, 5, 21)
    exact = optimal_gains(A, B, COST.M, COST.R, COST.terminal, 5.0, times)
    ratios = []
    for seed in range(8):
        states, inputs = motion(seed, 250, 1e-3)
        plant = identify(states, inputs, 0.01, window=10)
        learner = QLearner(COST, LearnerSettings(window=10))
        learner.absorb(states, inputs)
        own = relative_gain_error(learner.learned().gain(times), exact)
        ratios.append(own / relative_gain_error(plant.riccati(COST).gain(times), exact))
    assert np.median(ratios) > 1.5


def test_data_that_do_not_tell_the_plant_are_refused():
    states, inputs = motion(0, 50, 0.0)
    with pytest.raises(ValueError, match="not exciting enough"):
        identify(np.zeros_like(states), inputs, 0.01)
    with pytest.raises(ValueError, match="samples, inputs: must be"):
        identify(states[:-1], inputs, 0.01)
