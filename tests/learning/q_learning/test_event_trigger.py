"""The trigger: its identity, its bound on the cost, and what it saves."""

import numpy as np
import pytest
from plants_for_learning import HiddenPlant, exact_map

from learning.q_learning.event_trigger import IntermittentController, NormTrigger, QuadraticTrigger
from learning.q_learning.learned_regulator import solve_backward
from learning.q_learning.quadratic_cost import QuadraticCost

A = np.array([[0.0, 1.0], [0.5, 0.2]])
B = np.array([[0.0], [1.0]])
COST = QuadraticCost(10 * np.eye(2), 2 * np.eye(1), 0.5 * np.eye(2), 5.0)
REGULATOR = solve_backward(COST, exact_map(A, B), affine=False)
PERIOD = 0.002
START = np.array([1.0, -0.5])


def run(controller):
    """Cost, and the integral of d'R d, d the input's distance from the optimal one."""
    plant = HiddenPlant(A, B, START, PERIOD)
    cost, distance = 0.0, 0.0
    for k in range(round(COST.horizon / PERIOD)):
        x = plant.state
        u = controller.control(x)
        ends = []
        for state, time in ((x, k * PERIOD), (plant.step(u), (k + 1) * PERIOD)):
            gap = u + REGULATOR.gain(time) @ state
            running = state @ COST.M @ state + u @ COST.R @ u
            ends.append((running, gap @ COST.R @ gap))
        cost += PERIOD / 2 * (ends[0][0] + ends[1][0])
        distance += PERIOD / 2 * (ends[0][1] + ends[1][1])
    x = plant.state
    return cost + x @ COST.terminal @ x, distance


@pytest.mark.parametrize("share", [0.02, 0.2])
def test_the_cost_exceeds_the_optimum_by_the_integral_of_the_squared_distance(share):
    controller = IntermittentController(REGULATOR, QuadraticTrigger(COST, share), PERIOD)
    cost, distance = run(controller)
    best = float(REGULATOR.value(START))
    # Trapezoid on 2 ms: second order in steps of a motion with rates of a few per second.
    assert cost - best == pytest.approx(distance, rel=0.02, abs=1e-4 * best)
    assert best < cost <= best / (1 - share) * (1 + 1e-3)
    assert controller.updates < 0.1 * controller.looks


def test_a_tighter_trigger_updates_more_and_costs_less():
    results = []
    for share in (0.01, 0.05, 0.25):
        controller = IntermittentController(REGULATOR, QuadraticTrigger(COST, share), PERIOD)
        cost, _ = run(controller)
        results.append((controller.updates, cost))
    updates, costs = zip(*results, strict=True)
    assert updates[0] > updates[1] > updates[2] > 1
    assert costs[0] < costs[1] < costs[2]


def test_the_norm_test_implies_the_quadratic_one_for_a_constant_gain():
    rng = np.random.default_rng(0)
    norm, decay = NormTrigger(COST, 0.7), 0.7
    gain = REGULATOR.gain(0.0)
    kept = 0
    for _ in range(400):
        held = rng.normal(size=2)
        x = held + 0.3 * rng.normal(size=2)
        u = -gain @ held
        if not norm.is_due(x, held, u, gain):
            kept += 1
            gap = u + gain @ x
            bound = (1 - decay**2) * (x @ COST.M @ x) + u @ COST.R @ u
            assert gap @ COST.R @ gap <= bound
    assert 20 < kept < 400


def test_a_new_leg_renews_the_input_at_once():
    controller = IntermittentController(REGULATOR, QuadraticTrigger(COST, 0.5), PERIOD)
    controller.control(START)
    held = controller.control(1.001 * START)
    assert controller.updates == 1
    controller.new_leg()
    assert not np.array_equal(controller.control(1.001 * START), held)
    assert controller.updates == 2


def test_bad_shares_and_affine_plants_are_refused():
    with pytest.raises(ValueError, match="share"):
        QuadraticTrigger(COST, 1.0)
    with pytest.raises(ValueError, match="decay"):
        NormTrigger(COST, 0.0)
    wide = solve_backward(
        COST.with_constant(),
        exact_map(np.pad(A, ((0, 1), (0, 1))), np.vstack([B, [[0.0]]])),
        affine=True,
    )
    with pytest.raises(ValueError, match="regulator"):
        IntermittentController(wide, QuadraticTrigger(COST), PERIOD)
