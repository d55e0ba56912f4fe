"""`zermelo navigate` from end to end: Drake's motion, its collisions, and the JSON contract."""

import json
import subprocess
import sys

import numpy as np
import pytest

from planners.navigation_settings import FLOWING, PAPER
from planners.orders import Phase
from sims.navigation.navigate import document, navigate, run
from sims.navigation.scenario_file import Scenario
from sims.navigation.scenario_generator import load, random_crowd, random_scenario, random_team
from sims.navigation.scenario_parts import gap
from sims.regulation.simulation import LinearPlant

KEYS = {
    "reached", "collided", "duration_s", "length_m", "min_clearance_m", "max_deviation_m",
    "replans", "legs", "missed_deadlines",
}  # fmt: skip
POST = {"center": [0.0, 0.2], "radius": 0.8}
HALL = {
    "plant": "springless-rover",
    "start": [-4.0, 0.0],
    "goal": [4.0, 0.0],
    "robot_radius": 0.2,
    "arena": {"lower": [-6.0, -6.0], "upper": [6.0, 6.0]},
    "obstacle": [POST],
    "time_limit": 30.0,
}


def go(controller="q-learning", rules=None, seed=0, **changes):
    return run(Scenario.from_dict(HALL | changes), controller, seed, rules, nodes=400)


@pytest.fixture(scope="module")
def crossing():
    return go()[0]


def test_the_robot_learns_drives_and_arrives(crossing):
    assert crossing.reached
    assert not crossing.collided
    assert crossing.phases[0] is Phase.LEARNING
    assert np.linalg.norm(crossing.track[-1] - [4.0, 0.0]) <= 0.25
    assert 8.0 - 0.25 <= crossing.length <= 12.0


def test_the_motion_is_the_plants(crossing):
    """Held inputs and matrix exponentials give the same states as Drake's integrator."""
    plant, driver = crossing.robot.plant, crossing.driver
    driven = [k for k, p in enumerate(crossing.phases) if p is Phase.DRIVING]
    F, G, _ = LinearPlant(plant.A, plant.B).held_step(crossing.sample_period)
    for k in driven[:-1]:
        after = F @ crossing.states[k] + G @ crossing.inputs[k]
        np.testing.assert_allclose(crossing.states[k + 1], after, atol=1e-5)
    assert driver.ready


def test_drakes_geometry_judges_at_every_integration_step(crossing):
    steps = np.diff(crossing.fine_times)
    assert steps.max() <= crossing.sample_period / 4 + 1e-9
    expected = np.linalg.norm(crossing.track - POST["center"], axis=1) - 0.8 - 0.2
    seen = np.isfinite(crossing.clearances)
    assert seen.all()
    np.testing.assert_allclose(crossing.clearances, expected, atol=1e-9)
    assert crossing.min_clearance == pytest.approx(expected.min())


def test_the_document_holds_what_was_promised_and_nothing_else(crossing):
    report = document([crossing])
    assert set(report) == KEYS
    assert report["reached"] is True
    assert report["replans"]
    for replan in report["replans"]:
        assert set(replan) == {"time_s", "cause", "latency_s", "nodes"}
        assert replan["cause"]
    json.dumps(report, allow_nan=False)


def test_equal_seeds_give_equal_runs_and_others_do_not(crossing):
    again, other = go()[0], go(seed=1)[0]
    np.testing.assert_array_equal(crossing.track, again.track)
    assert len(other.track) != len(crossing.track) or not np.allclose(other.track, crossing.track)
    timeless = KEYS - {"replans", "missed_deadlines"}
    first, second = document([crossing]), document([again])
    assert {k: first[k] for k in timeless} == {k: second[k] for k in timeless}
    assert [r["time_s"] for r in first["replans"]] == [r["time_s"] for r in second["replans"]]


def test_an_obstacle_upon_the_robot_is_a_collision_and_ends_the_run():
    upon = {"lower": [-6.0, -1.0], "upper": [-3.0, 1.0], "appears": 1.0}
    result = go(
        "riccati", obstacle=[upon], start=[-4.0, 0.5], goal=[-4.5, 0.5], goal_tolerance=0.01
    )
    result = result[0]
    assert result.collided
    assert not result.reached
    assert result.failure == "collided"
    assert result.duration == pytest.approx(1.0, abs=0.06)
    assert result.min_clearance is not None
    assert result.min_clearance < 0


def test_without_obstacles_there_is_no_clearance():
    report = document(go("riccati", obstacle=[]))
    assert report["reached"]
    assert report["min_clearance_m"] is None


def test_the_papers_simulation_is_the_physical_one_with_a_perfect_feedforward():
    """(26) in error coordinates, and with its spring fixed to the origin, drive the same way."""
    tracks = [go("riccati", plant=p)[0].track for p in ("rover", "rover-physical")]
    np.testing.assert_allclose(tracks[0], tracks[1], atol=1e-6)


def test_the_spring_that_the_paper_drops_pulls_an_uncontrolled_rover_to_the_origin():
    ends = {}
    for plant in ("rover", "rover-physical"):
        result = go("open-loop", plant=plant, obstacle=[], time_limit=60.0)[0]
        ends[plant] = result.track[-1], result.reached
    assert ends["rover"][1]
    assert not ends["rover-physical"][1]
    np.testing.assert_allclose(ends["rover-physical"][0], [0.0, 0.0], atol=0.01)


def test_obstacles_that_keep_away_appear_no_nearer_than_they_may():
    """The wall is due at once right before the robot; it waits until the robot is far enough."""
    wall = {"lower": [-2.5, -0.5], "upper": [-2.0, 0.5], "appears": 0.0}
    result = go("riccati", obstacle=[wall], appearance_distance=2.0)[0]
    assert result.reached
    appeared = [r.time for r in result.navigator.replans]
    solid = Scenario.from_dict(HALL | {"obstacle": [wall | {"appears": 1.0}]}).visitors[0].solid
    k = int(np.searchsorted(result.fine_times, appeared[0]))
    assert gap(solid, result.track[k]) - 0.2 >= 2.0 - 0.3


def test_an_obstacle_is_known_only_once_it_is_within_the_perception():
    result = go("riccati", perception_radius=2.0)[0]
    first = result.navigator.replans[0].time
    k = int(np.searchsorted(result.fine_times, first))
    away = np.linalg.norm(result.track - POST["center"], axis=1) - POST["radius"]
    assert away[k] <= 2.0 < away[max(0, k - 8)]


def test_rules_that_foretell_are_refused_for_controllers_that_cannot():
    with pytest.raises(ValueError, match="rules"):
        go("open-loop", FLOWING)
    with pytest.raises(ValueError, match="controller"):
        go("magic")


def test_two_robots_swap_places():
    robots = go(
        "riccati",
        obstacle=[],
        start=[-4.0, 0.0],
        goal=[4.0, 0.0],
        robot=[{"start": [4.0, 0.1], "goal": [-4.0, 0.1]}],
    )
    report = document(robots)
    assert report["reached"]
    assert not report["collided"]
    assert set(report) == KEYS | {"robots"}
    assert all(set(r) == KEYS for r in report["robots"])
    gaps = np.linalg.norm(robots[0].track - robots[1].track, axis=1) - 0.4
    np.testing.assert_allclose(robots[0].clearances, gaps, atol=1e-9)
    assert gaps.min() > 0


@pytest.mark.parametrize("make", [random_scenario, random_crowd, lambda s: random_team(s, 3)])
def test_random_scenarios_are_equal_for_equal_seeds_and_sound(make):
    assert make(4) == make(4)
    assert make(4) != make(5)
    load(make(4))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_random_dynamic_scenarios_are_crossed_safely(seed):
    result = run(load(random_scenario(seed)), "q-learning", seed)[0]
    assert result.reached
    assert not result.collided


@pytest.mark.slow
def test_the_papers_rules_are_slower_than_ours():
    durations = {rules: go("riccati", rules)[0].duration for rules in (PAPER, FLOWING)}
    assert durations[FLOWING] < 0.7 * durations[PAPER]


@pytest.mark.slow
def test_the_command_prints_one_document_and_pictures_where_asked(tmp_path):
    path = tmp_path / "hall.toml"
    path.write_text(
        'plant = "springless-rover"\nstart = [-4.0, 0.0]\ngoal = [4.0, 0.0]\n'
        "[arena]\nlower = [-6.0, -6.0]\nupper = [6.0, 6.0]\n"
        "[[obstacle]]\ncenter = [0.0, 0.2]\nradius = 0.8\n"
    )
    program = "from sims.cli import main; main()"
    out = tmp_path / "out"
    command = [sys.executable, "-c", program, "navigate", str(path), "--json", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert set(json.loads(done.stdout)) == KEYS
    assert json.loads((out / "navigate.json").read_text()) == json.loads(done.stdout)
    for name in ("navigate.png", "navigate.gif", "navigate.html"):
        assert (out / name).stat().st_size > 10_000
    assert navigate(path)["reached"]
