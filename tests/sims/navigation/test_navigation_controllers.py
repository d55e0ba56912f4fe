"""The controllers of legs: what they foretell is what happens, and what they learn is the plant."""

from typing import Any

import numpy as np
import pytest

from sims.navigation.controllers import CONTROLLERS, make_controller
from sims.navigation.navigate import stopping_time
from sims.navigation.plants import PLANTS
from sims.navigation.scenario_file import Scenario
from sims.regulation.simulation import LinearPlant

PERIOD = 0.05
FORESEEING = ("q-learning", "riccati")


def robot(name):
    d = 3 if name.endswith("3d") else 2
    table = {"plant": name, "start": [-5.0] * d, "goal": [5.0] * d}
    return Scenario.from_dict(table).robots[0]


class Loop:
    """A robot and its controller, in steps by matrix exponentials."""

    def __init__(self, name, controller, seed=0):
        self.robot = robot(name)
        self.reference = self.robot.at_rest(self.robot.start)
        self.state = self.reference.copy()
        rng = np.random.default_rng(seed)
        plant, cost = self.robot.plant, self.robot.cost
        self.driver = make_controller(controller, plant, cost, PERIOD, self.state, rng)
        F, G, _ = LinearPlant(plant.A, plant.B).held_step(PERIOD / self.driver.substeps)
        self.F, self.G, self.anchored = F, G, plant.anchored

    def sample(self):
        for _ in range(self.driver.substeps):
            u = self.driver.feedforward(self.reference)
            u = u + self.driver.control(self.state - self.reference)
            origin = self.reference if self.anchored else 0.0
            self.state = self.F @ (self.state - origin) + self.G @ u + origin

    def until_ready(self):
        for _ in range(200):
            if self.driver.ready:
                return
            self.sample()
        raise AssertionError("never ready")


@pytest.mark.parametrize("receding", [True, False])
@pytest.mark.parametrize("controller", FORESEEING)
@pytest.mark.parametrize("name", list(PLANTS))
def test_what_is_foretold_is_what_happens(name, controller, receding):
    loop = Loop(name, controller)
    loop.until_ready()
    d = loop.robot.plant.dimension
    loop.reference = loop.robot.at_rest(loop.robot.start + 3.0)
    loop.driver.new_leg()
    forecast = loop.driver.forecast((loop.state - loop.reference)[None], receding)
    assert forecast is not None
    told = forecast[0]
    happened = [loop.state[:d]]
    for _ in range(len(told) - 1):
        if receding:
            loop.driver.new_leg()
        loop.sample()
        happened.append(loop.state[:d])
    np.testing.assert_allclose(told + loop.reference[:d], happened, atol=1e-6)
    # It is told up to standstill: a hundredth of what is left of 3 m and the speed.
    assert len(told) > 20
    assert np.abs(told[-1]).max() < 0.2


@pytest.mark.parametrize("name", list(PLANTS))
def test_learning_ends_with_the_optimal_gain_and_never_sees_the_plant(name):
    exact: Any = make_controller(
        "riccati", robot(name).plant, robot(name).cost, PERIOD, np.zeros(1), np.random.default_rng()
    )
    loop = Loop(name, "q-learning", seed=3)
    assert not loop.driver.ready
    assert loop.driver.forecast(np.zeros((1, loop.robot.plant.n)), True) is None
    loop.until_ready()
    learned: Any = loop.driver
    error = np.linalg.norm(learned.gains - exact.gains) / np.linalg.norm(exact.gains)
    assert error < 1e-5
    for value in vars(loop.driver).values():
        assert value is not loop.robot.plant


def test_a_robot_with_a_spring_learns_what_holds_it_anywhere():
    loop = Loop("rover-physical", "q-learning")
    loop.until_ready()
    there = loop.robot.at_rest(np.array([7.0, -3.0]))
    expected = loop.robot.plant.holding_input(there)
    np.testing.assert_allclose(loop.driver.feedforward(there), expected, rtol=1e-4)
    np.testing.assert_allclose(expected, [140.0, -60.0])


def test_the_stopping_time_of_a_double_integrator_is_near_that_of_its_best_brake():
    """By search over references on a fine grid, with an integration of its own."""
    rover = robot("double-integrator")
    exact: Any = make_controller(
        "riccati", rover.plant, rover.cost, PERIOD, np.zeros(4), np.random.default_rng()
    )
    k_p, k_v = exact.gains[0][0, [0, 2]]
    farthest = []
    for reference in np.linspace(-1.0, 1.0, 201):
        p, v, most = 0.0, 1.0, 0.0
        for _ in range(160):
            u = -k_p * (p - reference) - k_v * v
            p, v = p + PERIOD * v + PERIOD**2 / 2 * u, v + PERIOD * u
            most = max(most, abs(p))
        farthest.append(most)
    assert min(farthest) <= stopping_time(rover, PERIOD) <= min(farthest) + 0.02


@pytest.mark.parametrize("name", CONTROLLERS)
def test_every_controller_answers_with_an_input_of_the_right_size(name):
    loop = Loop("springless-rover", name)
    u = loop.driver.control(loop.state - loop.reference)
    assert u.shape == (2,)
    assert np.isfinite(u).all()


def test_an_unknown_controller_is_refused():
    with pytest.raises(ValueError, match="controller: 'magic'"):
        Loop("rover", "magic")
