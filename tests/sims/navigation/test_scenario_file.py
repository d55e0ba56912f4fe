"""Scenario files: the shipped ones are sound, bad ones are refused by the field's name."""

import copy
import math
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from planners.solids import Solid
from sims.navigation.plants import PLANTS
from sims.navigation.scenario_file import Scenario, shipped_scenarios
from sims.navigation.scenario_parts import gap

GOOD = {
    "plant": "springless-rover",
    "start": [-15.0, -15.0],
    "goal": [17.0, 17.0],
    "obstacle": [
        {"center": [0.0, 0.0], "radius": 1.0},
        {"vertices": [[3.0, 3.0], [5.0, 3.0], [4.0, 5.0]], "appears": 2.0, "vanishes": 9.0},
        {"lower": [-8.0, 2.0], "upper": [-6.0, 3.0], "velocity": [0.5, 0.0]},
    ],
    "robot": [{"start": [-15.0, 15.0], "goal": [15.0, -15.0]}],
}


def changed(path, value):
    """GOOD with one entry replaced (or taken out, if the value is None)."""
    table = copy.deepcopy(GOOD)
    place: Any = table
    for key in path[:-1]:
        place = place[key] if isinstance(key, int) else place.setdefault(key, {})
    if value is None:
        del place[path[-1]]
    else:
        place[path[-1]] = value
    return table


def test_the_promised_scenarios_are_shipped_and_load():
    shipped = shipped_scenarios()
    assert {"figure-2", "warehouse", "crowd", "cul-de-sac", "space"} <= set(shipped)
    for path in shipped.values():
        Scenario.load(path)


def test_the_papers_values_are_the_defaults():
    scenario = Scenario.from_dict(GOOD)
    written_out = Scenario.load(shipped_scenarios()["figure-2"])
    for name in ("perception_radius", "admissible_window", "horizon", "sample_period"):
        assert getattr(scenario, name) == getattr(written_out, name)
    for name in ("M", "R", "terminal"):
        ours, theirs = (getattr(s.robots[0].cost, name) for s in (scenario, written_out))
        np.testing.assert_array_equal(ours, theirs)
    assert scenario.perception_radius == 8.0
    assert scenario.goal_tolerance == 0.25
    np.testing.assert_array_equal(scenario.robots[0].cost.M, 10 * np.eye(4))


def test_obstacles_come_in_three_forms_and_robots_in_any_number():
    scenario = Scenario.from_dict(GOOD)
    assert [v.solid.shape.value for v in scenario.visitors] == ["ball", "polygon", "polygon"]
    assert [v.appears for v in scenario.visitors] == [0.0, 2.0, 0.0]
    assert [v.vanishes for v in scenario.visitors] == [math.inf, 9.0, math.inf]
    assert [v.moves for v in scenario.visitors] == [False, False, True]
    assert len(scenario.robots) == 2
    assert scenario.robots[1].plant.name == "springless-rover"


def test_a_plant_of_ones_own_is_a_table():
    A = [[0, 0, 1, 0], [0, 0, 0, 1], [0, 0, -0.3, 0], [0, 0, 0, -0.3]]
    B = [[0, 0], [0, 0], [1, 0.2], [0, 1]]
    scenario = Scenario.from_dict(changed(["plant"], {"A": A, "B": B, "probing": 1.5}))
    plant = scenario.robots[0].plant
    assert (plant.n, plant.m, plant.dimension, plant.probing) == (4, 2, 2, 1.5)


REFUSED = {
    "an unknown key": (["colour"], "red", "colour"),
    "an unknown key of an obstacle": (["obstacle", 0, "colour"], "red", "obstacle 1.colour"),
    "an unknown key of a robot": (["robot", 0, "colour"], "red", "robot 1.colour"),
    "no plant": (["plant"], None, "plant: missing"),
    "no goal": (["goal"], None, "goal: missing"),
    "an unknown plant": (["plant"], "tank", "plant: 'tank'"),
    "a start that is no list": (["start"], 3.0, "start"),
    "a start of words": (["start"], ["a", "b"], "start"),
    "a start off the arena": (["start"], [-50.0, 0.0], "start"),
    "a start in an obstacle": (["start"], [0.5, 0.0], "start"),
    "a goal that is not finite": (["goal"], [math.inf, 0.0], "goal"),
    "three coordinates in the plane": (["goal"], [1.0, 2.0, 3.0], "goal"),
    "a window of 1": (["admissible_window"], 1.0, "admissible_window"),
    "no perception": (["perception_radius"], 0.0, "perception_radius"),
    "a negative horizon": (["horizon"], -1.0, "horizon"),
    "samples beyond the horizon": (["sample_period"], 20.0, "sample_period"),
    "a number that is true": (["horizon"], True, "horizon"),
    "a negative body": (["robot_radius"], -0.1, "robot_radius"),
    "an empty arena": (["arena", "upper"], [-20.0, 20.0], "arena.upper"),
    "weights of a wrong size": (["weights", "M"], [[1.0]], "weights.M"),
    "weights that are indefinite": (["weights", "R"], [[1.0, 0.0], [0.0, -1.0]], "weights.R"),
    "an obstacle without extent": (["obstacle", 0, "radius"], 0.0, "obstacle 1"),
    "a disc without centre": (["obstacle", 0, "center"], None, "obstacle 1"),
    "a disc and a polygon at once": (["obstacle", 0, "vertices"], [[0, 0]], "obstacle 1"),
    "a polygon that is not convex": (
        ["obstacle", 1, "vertices"],
        [[0, 0], [2, 0], [0.2, 0.2], [0, 2]],
        "obstacle 2",
    ),
    "an obstacle that vanishes first": (["obstacle", 1, "vanishes"], 1.0, "obstacle 2.vanishes"),
    "a time before the beginning": (["obstacle", 1, "appears"], -1.0, "obstacle 2.appears"),
    "a velocity in space": (["obstacle", 2, "velocity"], [1.0, 0, 0], "obstacle 3.velocity"),
    "obstacles that are no tables": (["obstacle"], 3, "obstacle"),
    "a robot on another": (["robot", 0, "start"], [-15.0, -15.0], "robot 1.start"),
}


@pytest.mark.parametrize(("path", "value", "named"), REFUSED.values(), ids=REFUSED)
def test_refused(path, value, named):
    with pytest.raises(ValueError, match=r"^" + named.replace(".", r"\.")):
        Scenario.from_dict(changed(path, value))


def test_a_robot_that_cannot_stand_still_is_refused_unless_it_is_simulated_in_error_coordinates():
    A = [[-1, 0, 1, 0], [0, -1, 0, 1], [0, 0, 0, 0], [0, 0, 0, 0]]
    B = [[0, 0], [0, 0], [1, 0], [0, 1]]
    table = {"A": A, "B": B}
    with pytest.raises(ValueError, match=r"plant\.A: no input holds"):
        Scenario.from_dict(changed(["plant"], table))
    anchored = Scenario.from_dict(changed(["plant"], table | {"anchored": True}))
    assert anchored.robots[0].plant.anchored


@pytest.mark.parametrize("name", list(PLANTS))
def test_every_plant_stands_still_where_it_is_held(name):
    plant = PLANTS[name]()
    rest = np.concatenate([np.full(plant.dimension, 7.0), np.zeros(plant.n - plant.dimension)])
    A = np.zeros_like(plant.A) if plant.anchored else plant.A
    np.testing.assert_allclose(A @ rest + plant.B @ plant.holding_input(rest), 0.0, atol=1e-9)


def test_the_gap_to_a_solid():
    square = Solid.box([0.0, 0.0], [2.0, 2.0])
    assert gap(square, np.array([5.0, 6.0])) == pytest.approx(5.0)
    assert gap(square, np.array([1.0, 3.0])) == pytest.approx(1.0)
    assert gap(square, np.array([1.0, 1.5])) == pytest.approx(-0.5)
    assert gap(Solid.ball([0.0, 0.0], 1.0), np.array([3.0, 4.0])) == pytest.approx(4.0)


def test_the_command_refuses_a_bad_file_with_status_2_and_the_fields_name(tmp_path):
    path = tmp_path / "bad.toml"
    path.write_text('plant = "rover"\nstart = [0.0, 0.0]\ngoal = [1.0, 1.0]\nhorizon = "long"\n')
    program = "from sims.cli import main; main()"
    command = [sys.executable, "-c", program, "navigate", str(path), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 2
    assert "horizon" in done.stderr
    assert "long" in done.stderr
    assert done.stdout == ""
