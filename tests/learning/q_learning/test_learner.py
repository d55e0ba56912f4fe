"""The law that converges, on plants it can only drive and measure."""

import numpy as np
import pytest
from plants_for_learning import HiddenPlant, exact_map, held_motion, optimal_gains

from learning.q_learning.certificate import measure_excitation, relative_gain_error
from learning.q_learning.learner import LearnerSettings, QLearner
from learning.q_learning.quadratic_cost import QuadraticCost
from learning.q_learning.window_regression import WindowRegression
from ocp.trajectory import SolveError

PERIOD = 0.01
OSCILLATOR = np.array([[0.0, 1.0], [-1.0, -0.4]]), np.array([[0.0], [1.0]])
UNSTABLE = np.array([[0.5, 0.5], [0.0, 1.0]]), np.array([[0.0], [1.0]])
COST = QuadraticCost(10 * np.eye(2), 2 * np.eye(1), 0.5 * np.eye(2), 5.0)
TIMES = np.linspace(0.0, COST.horizon, 21)


def true_gains(A, B, cost=COST, times=TIMES):
    return optimal_gains(A, B, cost.M, cost.R, cost.terminal, cost.horizon, times)


def drive(learner: QLearner, plant: HiddenPlant, seconds: float) -> np.ndarray:
    """All the learner gets is the state; all the plant gets is the input."""
    inputs = []
    for _ in range(round(seconds / PERIOD)):
        inputs.append(learner.control(plant.state))
        plant.step(inputs[-1])
    return np.array(inputs)


def test_it_learns_from_states_and_inputs_only():
    plant = HiddenPlant(*OSCILLATOR, [1.0, 0.0], PERIOD)
    assert not {"A", "B"} & set(dir(plant))
    learner = QLearner(COST)
    drive(learner, plant, 2.0)
    error = relative_gain_error(learner.learned().gain(TIMES), true_gains(*OSCILLATOR))
    assert error <= 1e-6
    assert learner.certificate is not None
    assert error <= 10 * learner.certificate.gain_error


def test_probing_stops_when_the_certificate_holds_and_the_optimal_input_takes_over():
    plant = HiddenPlant(*OSCILLATOR, [1.0, 0.0], PERIOD)
    learner = QLearner(COST, LearnerSettings(probing=2.0))
    assert learner.probing
    drive(learner, plant, 2.0)
    assert not learner.probing
    state = plant.state
    expected = -true_gains(*OSCILLATOR, times=np.array([learner.clock]))[0] @ state
    assert learner.control(state) == pytest.approx(expected, rel=1e-5)


def test_without_probing_the_data_are_reported_as_unexciting():
    """Under u = -K x the products u x are combinations of the products x x."""
    gain = np.array([[1.0, 1.0]])
    plant = HiddenPlant(*OSCILLATOR, [1.0, 0.0], PERIOD)
    learner = QLearner(COST, LearnerSettings(probing=0.0, substeps=1, behaviour_gain=gain))
    drive(learner, plant, 4.0)
    certificate = learner.certify()
    assert not certificate.holds
    assert certificate.excitation.rank < certificate.excitation.required_rank
    assert learner.probing
    with pytest.raises(SolveError, match="not exciting enough: rank"):
        learner.learned()


def test_a_plant_that_changes_is_probed_and_learned_again():
    other = np.array([[0.0, 1.0], [2.0, 0.3]])
    settings = LearnerSettings(memory=0.9, accuracy=0.02)
    learner = QLearner(COST, settings, np.random.default_rng(3))
    drive(learner, HiddenPlant(*OSCILLATOR, [1.0, 0.0], PERIOD), 2.0)
    assert not learner.probing
    learner.new_leg()
    plant = HiddenPlant(other, OSCILLATOR[1], [1.0, 0.0], PERIOD)
    probed = []
    for _ in range(600):
        plant.step(learner.control(plant.state))
        probed.append(learner.probing)
    assert any(probed)
    error = relative_gain_error(learner.learned().gain(TIMES), true_gains(other, OSCILLATOR[1]))
    assert error < 0.02


def test_an_unstable_plant_is_held_by_a_behaviour_gain():
    gain = np.array([[6.0, 4.0]])
    assert np.linalg.eigvals(UNSTABLE[0]).real.min() > 0
    plant = HiddenPlant(*UNSTABLE, [1.0, 1.0], PERIOD)
    settings = LearnerSettings(behaviour_gain=gain, probe_throughout=True, check_every=50)
    learner = QLearner(COST, settings)
    drive(learner, plant, 10.0)
    assert np.abs(plant.state).max() < 10
    assert relative_gain_error(learner.learned().gain(TIMES), true_gains(*UNSTABLE)) <= 1e-6


def test_legs_are_learned_across_waypoint_switches():
    learner = QLearner(COST, LearnerSettings(probe_throughout=True))
    plant = HiddenPlant(*OSCILLATOR, [1.0, 0.0], PERIOD)
    for offset in (0.0, 3.0, -2.0):
        learner.new_leg()
        assert learner.clock == 0.0
        # A switch in the middle of a hold: the broken hold is dropped with its window.
        plant.state = np.add(plant.state, [offset, 0.0])
        drive(learner, plant, 0.73)
    assert relative_gain_error(learner.learned().gain(TIMES), true_gains(*OSCILLATOR)) <= 1e-6


def test_a_spring_away_from_its_rest_is_learned_with_its_constant():
    """The exact answer: the same problem for [x, 1], whose optimal gain is [K, k]."""
    A, B = OSCILLATOR
    drift = np.array([0.0, 1.5])
    plant = HiddenPlant(A, B, [1.0, 0.0], PERIOD, drift)
    learner = QLearner(COST, LearnerSettings(affine=True, probing=2.0))
    drive(learner, plant, 2.0)
    learned = learner.learned()
    wide_A = np.zeros((3, 3))
    wide_A[:2] = np.column_stack([A, drift])
    wide = COST.with_constant()
    exact = true_gains(wide_A, np.vstack([B, [[0.0]]]), wide)
    assert learned.gain(TIMES) == pytest.approx(exact[..., :2], abs=1e-5 * np.abs(exact).max())
    assert learned.offset(TIMES) == pytest.approx(exact[..., 2], abs=1e-5 * np.abs(exact).max())
    assert np.abs(exact[..., 2]).max() > 0.1
    assert learned.input([0.3, 0.1], 1.0) == pytest.approx(
        -learned.gain(1.0) @ [0.3, 0.1] - learned.offset(1.0)
    )
    assert learned.value([0.3, 0.1], COST.horizon) == pytest.approx(0.5 * (0.3**2 + 0.1**2))


def test_taking_the_plant_for_linear_fails_where_it_is_affine():
    plant = HiddenPlant(*OSCILLATOR, [1.0, 0.0], PERIOD, [0.0, 1.5])
    learner = QLearner(COST, LearnerSettings(probing=2.0, probe_throughout=True))
    drive(learner, plant, 2.0)
    certificate = learner.certify()
    known = learner.regulator
    error = (
        1.0 if known is None else relative_gain_error(known.gain(TIMES), true_gains(*OSCILLATOR))
    )
    assert error > 1e-2
    assert not certificate.holds or error <= 10 * certificate.gain_error


@pytest.mark.parametrize("window", [1, 25])
def test_the_claim_covers_measurement_noise(window):
    A, B = OSCILLATOR
    exact = true_gains(A, B)
    errors, claims = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        inputs = 2 * rng.normal(size=(250, 1))
        clean = held_motion(A, B, [1.0, 0.0], PERIOD, 4, inputs)
        learner = QLearner(COST, LearnerSettings(window=window))
        learner.absorb(clean + 1e-3 * rng.normal(size=clean.shape), inputs)
        claims.append(learner.certify().gain_error)
        errors.append(relative_gain_error(learner.learned().gain(TIMES), exact))
    assert (np.array(errors) <= 10 * np.array(claims)).all()
    assert np.median(errors) <= 0.01
    # Nor is it so large that it says nothing.
    assert np.median(claims) <= 10 * np.median(errors)


def test_excitation_does_not_depend_on_the_coordinates_of_the_state():
    A, B = OSCILLATOR
    inputs = np.random.default_rng(0).normal(size=(30, 1))
    states = held_motion(A, B, [1.0, 0.0], PERIOD, 4, inputs)
    change = np.array([[1e3, 2.0], [1.0, 1e-2]])
    conditions = []
    for motion in (states, states @ change.T):
        data = WindowRegression(2, 1, PERIOD, 4, 1, 1.0)
        data.absorb(motion, inputs)
        conditions.append(measure_excitation(data, 1e7).condition)
    # White coordinates are unique up to a rotation, which mixes the columns that are then scaled.
    assert conditions[1] == pytest.approx(conditions[0], rel=0.5)


def test_too_few_windows_to_judge_are_not_called_learned():
    A, B = OSCILLATOR
    inputs = np.random.default_rng(0).normal(size=(6, 1))
    learner = QLearner(COST)
    learner.absorb(held_motion(A, B, [1.0, 0.0], PERIOD, 4, inputs), inputs)
    certificate = learner.certify()
    assert certificate.excitation.rank == certificate.excitation.required_rank == 5
    assert not certificate.holds
    assert "6 windows for 5 unknowns: at least 9" in certificate.reason


def test_an_excited_but_wrong_map_is_not_called_learned():
    """Noise as large as the motion fills every direction: the rank is full, the claim says no."""
    rng = np.random.default_rng(0)
    learner = QLearner(COST)
    learner.absorb(rng.normal(size=(401, 2)), rng.normal(size=(100, 1)))
    certificate = learner.certify()
    assert certificate.excitation.rank == 5
    assert not certificate.holds
    assert certificate.reason


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sample_period": 0.0}, "^sample_period"),
        ({"substeps": 9}, "^substeps"),
        ({"window": 0}, "^window"),
        ({"probing": -1.0}, "^probing"),
        ({"memory": 0.0}, "^memory"),
        ({"accuracy": np.nan}, "^accuracy"),
        ({"behaviour_gain": np.eye(3)}, "^behaviour_gain"),
        ({"behaviour_gain": np.full((1, 2), np.nan)}, "^behaviour_gain"),
    ],
)
def test_bad_settings_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        QLearner(COST, LearnerSettings(**change))


@pytest.mark.parametrize("state", [[1.0], [np.nan, 0.0], [[1.0, 2.0]]])
def test_bad_states_are_refused(state):
    with pytest.raises(ValueError, match="state: must be 2 finite"):
        QLearner(COST).control(state)


def test_the_exact_map_of_the_oracle_satisfies_the_integral_identity():
    """The tests' own oracle, held against a finite difference of the motion."""
    A, B = UNSTABLE
    x, u, step = np.array([0.3, -0.7]), np.array([0.4]), 1e-6
    ahead = HiddenPlant(A, B, x, step).step(u)
    products = [x[0] ** 2, x[0] * x[1], x[1] ** 2, u[0] * x[0], u[0] * x[1]]
    change = np.array([ahead[0] ** 2, ahead[0] * ahead[1], ahead[1] ** 2]) - products[:3]
    assert change / step == pytest.approx(exact_map(A, B).T @ products, abs=1e-5)
